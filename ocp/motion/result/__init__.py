"""What planning returns: plans of all kinds, their candidates, and the requests from which files declare them again."""
