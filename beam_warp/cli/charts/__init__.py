"""What `beam chart` is asked, what its charts are of, and how each is measured."""
