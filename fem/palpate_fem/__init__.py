"""Finite elements of the fingertip: skin, sealed fluid, core and indenter (fem/README.md).

::

    from palpate_fem.mesh.parametric import biotac
    from palpate_fem.mechanics.solver import Fingertip

    tip = Fingertip.pressurised(biotac())
    trajectory = tip.indent(indenter, path)
"""
