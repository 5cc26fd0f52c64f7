"""Sampling-based planning: collision-free joint paths of several homotopy classes, proven clear and shortened."""
