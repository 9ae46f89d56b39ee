"""Finite elements of the fingertip: reserved, no solver yet (fem/README.md).

Its contract on the wire exists: ``SimulationRequest``, ``SimulationProgress`` and
``SimulationReply`` in ``palpate.protos.messages``.
"""
