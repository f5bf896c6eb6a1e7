"""Cases on which methods fail, and what becomes of them here."""
