"""The viewer: our own frames in a browser, with controls."""
