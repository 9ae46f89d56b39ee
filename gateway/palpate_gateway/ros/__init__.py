"""Sensors behind ROS: live topics over rmw_zenoh, and bags."""
