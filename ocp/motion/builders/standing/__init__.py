"""Planning for machines that stand on the ground without being fixed to it, on one support or on several in turn."""
