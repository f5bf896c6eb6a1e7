"""The embedded demo: a figure whose truth is known."""
