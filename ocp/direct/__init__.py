"""Direct methods: transcribe a problem to a nonlinear program, solve it, and read the solution."""
