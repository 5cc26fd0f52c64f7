"""Planning for machines that stand on the ground without being fixed to it, on constant or changing support."""
