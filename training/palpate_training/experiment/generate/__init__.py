"""The experiment on simulated BioTacs, from parameters to data sets.

What simulates the skin and the electrodes is not here: `simulator` states what this folder needs of
it, and the command line passes it in.
"""
