"""Direct methods: transcribe a problem to a nonlinear program, solve it, read the answer."""
