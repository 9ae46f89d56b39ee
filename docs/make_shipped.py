"""Write docs/results/shipped.md and shipped.json: errors of the shipped bundles on new presses.

``python docs/make_shipped.py runs``    or without a folder: the page alone, from the JSON file

``runs`` holds experiments on the specimens that ship, at points that no training has seen: the page
says the commands. Half a minute on two cores.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from palpate_services.inference.repository import resolve
from palpate_training.figures.style import markdown_table
from palpate_training.tasks.evaluate import SHOWN, evaluate

PAGE = Path(__file__).parent / "results" / "shipped.md"
RESULTS = PAGE.with_suffix(".json")

RUNS = {
    "points": ("calibrate/mixed.h5", "check/mixed.h5", "test/mixed.h5"),
    "random": ("random/mixed.h5", "random-500/small.h5"),
}
TITLES = {"points": "like the paper's, at other points", "random": "at random"}
BUNDLES = {"features-twin": None, "field-twin": None, "synthesis-twin": "biotac-2"}
"""By the specimen whose rows are taken; None = all three."""

HEADS = {
    "all": "of all",
    "below_2n": "below 2 N",
    "2_to_8n": "2 to 8 N",
    "above_8n": "above 8 N",
    "from_2n": "from 2 N",
}
WORDS = {
    "force_magnitude": "force",
    "force_magnitude_over_norm": "force, over the true one",
    "force_angle": "its angle",
    "contact_location": "contact location",
    "centre_of_pressure": "centre of pressure",
    "contact_normal": "contact normal",
    "displacement_128_nodes": "skin, the paper's 128 nodes",
    "displacement": "skin, all 6,870 nodes",
    "contact_force_misplaced": "contact forces on other nodes or turned, spread over 1.5 mm",
    "electrodes": "electrodes of `biotac-2` from the skin",
}
PAPER = {
    "force_magnitude": "0.64",
    "contact_location": "2.0",
    "displacement_128_nodes": "0.22",
    "electrodes": "66 to 80",
}
"""The paper's, all BioTacs together, on its own, real or finite-element, data."""


def main() -> None:
    """Measure if experiments are named, and write the page."""
    if len(sys.argv) > 1:
        found = {
            presses: [
                evaluate(
                    resolve(name),
                    [Path(sys.argv[1]) / run for run in runs],
                    unit=unit,
                ).as_dict()
                for name, unit in BUNDLES.items()
            ]
            for presses, runs in RUNS.items()
        }
        RESULTS.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(json.loads(RESULTS.read_text(encoding="utf-8"))), encoding="utf-8")


def table_of(found: list[dict[str, Any]]) -> str:
    """Errors of all bundles on one kind of presses."""
    rows = []
    for one in found:
        at = {(figure["name"], figure["where"]): figure for figure in one["figures"]}
        for name in dict.fromkeys(figure["name"] for figure in one["figures"]):
            figure = at[name, "all"]
            unit, factor = SHOWN.get(figure["unit"], (figure["unit"], 1.0))
            low, high = (f"{factor * end:.3g}" for end in figure["ci95"])
            rows.append(
                [
                    one["bundle"],
                    f"{WORDS[name]} [{unit}]",
                    figure["statistic"],
                    *(f"{factor * at[name, where]['value']:.3g}" for where in HEADS),
                    f"{low} to {high}",
                    *(
                        "" if figure[rival] is None else f"{factor * figure[rival]:.3g}"
                        for rival in ("constant", "zero")
                    ),
                    PAPER.get(name, ""),
                ]
            )
    heads = ["bundle", "error", "", *HEADS.values(), "95 %, of all", "constant", "zero", "paper"]
    return markdown_table(heads, rows, words=3)


def page(found: dict[str, list[dict[str, Any]]]) -> str:
    """The page."""
    tables = "\n".join(
        f"## Presses {TITLES[presses]}\n\n"
        f"{errors[0]['presses']} presses, {errors[0]['rows']} rows from 0.5 N.\n\n"
        f"{table_of(errors)}"
        for presses, errors in found.items()
    )
    return f"""# Errors of the bundles that ship

Made by `python docs/make_shipped.py runs`, on presses that no training has seen, on the three
specimens that ship; simulated fingers only. The same for any bundle and data set:
`palpate train evaluate BUNDLE DATA`.

<!-- run by: tests/deploy/test_generate.py [palpate data generate],
     tests/training/fields/test_more_presses.py [palpate data shrink] -->
```sh
palpate data generate runs/calibrate --points 3 --angled 2 --seed 11 --exact-labels
palpate data generate runs/check --points 2 --angled 2 --seed 12 --exact-labels
palpate data generate runs/test --points 2 --angled 2 --seed 13 --exact-labels
palpate data generate runs/random --random 90 --seed 901 --exact-labels \\
    --registration-seed 0 --units-each 2
palpate data generate runs/random-500 --random 500 --seed 905 --exact-labels \\
    --registration-seed 0 --units-each 2
palpate data shrink runs/random-500/mixed.h5 runs/random-500/small.h5 \\
    --trials 4000 --rows 10 --modes 128 --force-modes 96
```

The columns from *below 2 N* on are for rows with such a force. The 95 % interval is over presses.
The last columns are of all rows. *Constant* is the error of the mean of these rows, *zero* that of
no force, a skin at rest and electrodes that do not change. *Paper* is the paper's result on all its
BioTacs together, on real sensors (for the skin: on its own simulations; for electrodes: on each).
The bounds of the first two bundles were learned from `calibrate`, `check` and
[2,000 random presses](intervals.md); no weights were learned from these. Locations are where the
tip was: no registration error of a robot is in them. The errors of each bundle on presses that its
own training held out are on [its card](../models.md).
[How they were trained](../twin.md#networks).

{tables}"""


if __name__ == "__main__":
    main()
