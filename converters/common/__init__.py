"""What every format shares: options, importers, frames in and out, colours, rotations, axes and errors."""
