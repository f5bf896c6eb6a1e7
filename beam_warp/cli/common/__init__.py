"""What all commands share: options, pages of help, progress, and errors in one line."""
