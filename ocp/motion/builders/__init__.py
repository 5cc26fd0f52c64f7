"""Builders of optimal control problems, a module for each family of machines and tasks, and planners for them."""
