"""Pictures: files, colour, tone, film, panels, and how far two images differ."""
