"""Optimal control problems of robot arms in space: the capture of a tumbling body."""
