"""Ready problems, one module for each family of machines and tasks."""
