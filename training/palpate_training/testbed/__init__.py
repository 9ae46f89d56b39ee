"""The testbed: registration, kinematics, plan, and the streams of real and played experiments."""
