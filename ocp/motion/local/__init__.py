"""Local methods: inverse kinematics and redundancy resolution at velocity and acceleration level."""
