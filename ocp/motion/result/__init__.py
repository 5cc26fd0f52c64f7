"""Results of planning: plans of all kinds, candidate motions, and requests from which problems are declared again."""
