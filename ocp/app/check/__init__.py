"""Checks of trajectories that anybody made, sample by sample and between the samples."""
