"""The experiment on the twin, from parameters to data sets: finite elements, electrodes, testbed.

Only this room may join `fem`, which simulates, and `training`, which processes as the paper does.
"""
