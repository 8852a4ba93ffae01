"""What a model, a guide and an entry must be."""
