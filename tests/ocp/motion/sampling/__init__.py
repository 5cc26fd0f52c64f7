"""Tests of `ocp.motion.sampling`."""
