"""Checks of joint trajectories from any source, at the samples and between them."""
