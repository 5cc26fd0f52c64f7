"""Problem builders, one module for each family of machines and tasks, and the planners that solve them."""
