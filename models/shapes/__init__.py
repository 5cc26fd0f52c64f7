"""Bodies in space and the distances between them, as expressions."""
