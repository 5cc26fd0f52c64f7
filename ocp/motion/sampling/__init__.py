"""Sampling-based planning of joint paths of several homotopy classes; all paths are proven collision-free."""
