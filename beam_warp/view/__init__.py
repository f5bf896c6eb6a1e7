"""The viewer: the player page, drawn by whoever looks, and a server for what a take lacks and for exact stills."""
