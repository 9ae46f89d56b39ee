"""Write docs/models.md: the cards of the bundles that ship (``make docs``).

``python docs/make_models.py``          writes the page
``python docs/make_models.py --check``  exits 1 if the committed page is not what it would write
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

from palpate.files.bundle import read_bundle
from palpate.files.card import model_card

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "models.md"
MODELS = ROOT / "services" / "palpate_services" / "models"
HEAD = """\
<!-- Written by docs/make_models.py from the bundles that ship; do not edit. -->
# Models that ship

They were trained on simulated fingers alone: on a real sensor their numbers mean nothing until you
train your own. Each section is the card that `palpate model card` shows. What each model costs per
frame: [results/networks.md](results/networks.md). How they are trained: [twin.md](twin.md).
"""


def page() -> str:
    """The whole page."""
    parts = [HEAD]
    for folder in sorted(path.parent for path in MODELS.glob("*/*/manifest.json")):
        bundle = read_bundle(folder)
        card = model_card(bundle.manifest, bundle.sha256)
        parts.append(
            "\n".join(f"#{line}" if line[:1] == "#" else line for line in card.split("\n"))
        )
    return "\n".join(parts)


if __name__ == "__main__":
    sys.exit(FRESH["write_or_check"]({PAGE: page()}))
