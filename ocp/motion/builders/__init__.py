"""Ready problems, one module for each family of machines and tasks; `task` holds what they share."""
