"""Functions that declare and solve optimal control problems of motions, by family of machines and tasks."""
