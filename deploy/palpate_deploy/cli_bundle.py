"""``palpate model`` and ``palpate bundle``: bundles that are there, and making one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from palpate_deploy.options import JsonOption, example, group

model_app = group("Bundles of networks: list and verify.")
bundle_app = group("Make bundles.")


@model_app.command("list", epilog=example("palpate model list"))
def list_(json_: JsonOption = False) -> None:
    """The bundles that come with this palpate."""
    from palpate_deploy.models import list_models

    list_models(as_json=json_)


@model_app.command(epilog=example("palpate model verify features-virtual"))
def verify(
    bundle: Annotated[str, typer.Argument(help="Name, name:version or folder.")],
) -> None:
    """Check digests, contract and golden vectors of a bundle."""
    from palpate_deploy.models import verify_model

    verify_model(bundle)


@bundle_app.command(epilog=example("palpate bundle virtual --out runs/bundle/1 --frames 20000"))
def virtual(
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; default: the one that ships.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1000, help="Frames of the virtual finger.")] = 160_000,
    seed: Annotated[int, typer.Option(min=0, help="Of the finger, and of training.")] = 1,
) -> None:
    """Train the features bundle of the demo on the virtual finger (needs palpate[training])."""
    from palpate_deploy.bundle import make_virtual_bundle

    make_virtual_bundle(out, frames=frames, seed=seed)


@bundle_app.callback()
def _group() -> None:
    """Keep ``virtual`` a sub-command although it is the only one."""
