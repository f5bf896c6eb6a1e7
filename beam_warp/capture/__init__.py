"""Multi-view captures: loaders, lenses, inspection, and how a report of one looks."""
