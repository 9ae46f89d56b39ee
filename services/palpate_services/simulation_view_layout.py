"""How simulations are laid out on the screen: a tab for each trajectory, one timeline of steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from palpate.extras import require
from palpate_services.blueprint import AXES, AXIS_COLOURS, BACKGROUND, QUIET_COLOUR

STEP = "step"
"""The timeline: number of the step, which is that of the pose in the path; 0 = untouched."""

SIDES = ("left", "right")
"""Halves of the skin, y > 0 and y < 0; without the right one the finger is cut open."""


def layout(trajectories: Sequence[str], longest_m: float) -> Any:
    """Blueprint of these trajectories.

    Args:
        trajectories: Ids, in order of their tabs.
        longest_m: Displacement that has the last colour [m].
    """
    rrb = require("rerun.blueprint", extra="services")
    tabs = [_tab(rrb, name, longest_m) for name in trajectories]
    return rrb.Blueprint(
        tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs),
        # Following begins at the last step, where there is most to see.
        rrb.TimePanel(timeline=STEP, state="collapsed", play_state="following", fps=5.0),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def series(rr: Any) -> dict[str, Any]:
    """Looks of the curves, by entity below the trajectory."""
    looks = {
        f"force/{axis}": rr.SeriesLines(names=[f"F{axis}"], colors=[colour], widths=[2.0])
        for axis, colour in zip(AXES, AXIS_COLOURS, strict=True)
    }
    for name, words in (
        ("pressure", "fluid"),
        ("area", "contact"),
        ("newton", "Newton iterations"),
    ):
        looks[name] = rr.SeriesLines(names=[words], colors=[QUIET_COLOUR], widths=[2.0])
    return looks


def _tab(rrb: Any, trajectory: str, longest_m: float) -> Any:
    def space(name: str, position: Sequence[float], *, without: str) -> Any:
        return rrb.Spatial3DView(
            origin=f"{trajectory}/finger",
            contents=["$origin/**", f"- $origin/{without}/**"],
            name=name,
            background=BACKGROUND,
            line_grid=rrb.LineGrid3D(visible=False),
            eye_controls=rrb.EyeControls3D(
                position=position, look_target=(-0.005, 0.0, -0.003), eye_up=(0.0, 0.0, 1.0)
            ),
        )

    def plot(entity: str, name: str, *, legend: bool = False) -> Any:
        return rrb.TimeSeriesView(
            origin=f"{trajectory}/{entity}",
            name=name,
            axis_x=rrb.TimeAxis(link="LinkToGlobal"),
            plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
            background=rrb.archetypes.PlotBackground(color=BACKGROUND, show_grid=True),
        )

    return rrb.Horizontal(
        rrb.Vertical(
            space(
                f"Skin, indenter left out; colour: displacement, 0 to {1e3 * longest_m:.2g} mm",
                (0.002, -0.011, -0.034),
                without="indenter",
            ),
            space("Cut open at y = 0", (-0.001, -0.034, -0.010), without=f"skin/{SIDES[1]}"),
        ),
        rrb.Vertical(
            plot("force", "Force on the BioTac [N]", legend=True),
            plot("pressure", "Fluid pressure [Pa]"),
            rrb.Horizontal(plot("area", "Contact area [m²]"), plot("newton", "Newton iterations")),
            rrb.TextDocumentView(origin=f"{trajectory}/about", name="About"),
            row_shares=[3, 2, 2, 2],
        ),
        column_shares=[3, 2],
        name=trajectory,
    )
