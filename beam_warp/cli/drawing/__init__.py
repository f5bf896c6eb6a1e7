"""What `beam render` and `beam channel` share: options of cameras and lights, the checks of them, what is drawn."""
