"""What a machine is asked to do: frames and their poses or twists over time, where a standing machine's weight is."""
