"""Sampling-based planning of joint paths in several homotopy classes, which are proven collision-free."""
