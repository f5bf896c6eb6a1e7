"""The rules of the specification, what runs them, and what mends what breaks them."""
