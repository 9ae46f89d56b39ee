"""Write docs/results/networks.md and networks.json: what each network costs per frame.

``python docs/make_networks.py``

Each network is exported to ONNX as bundles are and run by ONNX Runtime on one thread, one frame
after the other, on a machine that does nothing else. Its weights are not trained, which costs the
same. Of the bundles that ship, operators, operator set, size and parity are listed, too.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from palpate.anatomy import ELECTRODE_POSITIONS
from palpate_deploy.bench.results import machine
from palpate_training.datasets.experiment import read_mixed
from palpate_training.datasets.features import ELECTRODES
from palpate_training.figures.style import markdown_table
from palpate_training.learning.electrode_nets import (
    ASSUMED_REST,
    MIRROR_AXES,
    ElectrodeNet,
    MembersConfig,
    ResidualLayers,
)
from palpate_training.learning.export import onnx_bytes
from palpate_training.learning.networks import Mlp, Standardised
from palpate_training.systems import latent, ours, perceptrons, points, ruppel, voxels

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results" / "networks.md"
RESULTS = PAGE.with_suffix(".json")
FASTER_HOST = RESULTS.with_stem("networks-faster-host")
MODELS = ROOT / "services" / "palpate_services" / "models"
SAMPLE = ROOT / "training" / "palpate_training" / "samples" / "twin.h5"

RUNS = 500
GOAL_MS = {"features": 0.2, "field": 3.0, "synthesis": 3.0}
REST = np.full(ELECTRODES, ASSUMED_REST, np.float32)


class Projected(nn.Module):
    """A latent projection, from the given side to the wanted one."""

    def __init__(self, inputs: int, outputs: int, *, to_mesh: bool) -> None:
        super().__init__()
        signal = (latent.SIGNAL_WIDTHS, latent.SIGNAL_LATENT)
        mesh = (latent.MESH_WIDTHS, latent.MESH_LATENT)
        given, wanted = (signal, mesh) if to_mesh else (mesh, signal)
        self.source = latent.VariationalAutoencoder(inputs, *given)
        self.target = latent.VariationalAutoencoder(outputs, *wanted)
        widths = latent.SIGNAL_TO_MESH if to_mesh else latent.MESH_TO_SIGNAL
        self.between = Mlp(widths, given[1], outputs=wanted[1])

    def forward(self, values: Tensor) -> Tensor:
        """Values of the wanted side."""
        mean: Tensor = self.source.encoder(values)[:, : self.source.latent]
        wanted: Tensor = self.target.decoder(self.between(mean))
        return wanted


class Flat(nn.Module):
    """Layers that take rows alone, given rows and their mirror images (N, 2, I)."""

    def __init__(self, layers: nn.Module) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, inputs: Tensor) -> Tensor:
        """Estimates (N, 2, 3)."""
        estimate: Tensor = self.layers(inputs.reshape(-1, inputs.shape[-1]))
        return estimate.reshape(-1, 2, 3)


def of_features() -> Iterator[tuple[str, nn.Module, int]]:
    """Networks of one quantity of three values, and their inputs."""
    yield "MLP (the paper's)", Mlp(), ELECTRODES
    yield (
        "Wettels 2011: MLP",
        Mlp((max(perceptrons.WETTELS_WIDTHS),), activation="tanh"),
        ELECTRODES,
    )
    for layers in (2, 4):
        widths = (max(perceptrons.SU_WIDTHS),) * (layers - 1)
        yield f"Su 2015: {layers}-layer MLP", Mlp(widths, activation="tanh"), ELECTRODES
    yield "voxel network (the paper's)", Standardised(voxels.PaperVoxelNet()), ELECTRODES
    yield "Sundaralingam 2019: voxels, projection loss", voxels.ProjectionNet(), ELECTRODES
    for name, layers_of in (
        ("PointNet++ (the paper's)", points.PUBLISHED),
        ("PointNet++, radii 6 and 10 mm", points.FITTED),
    ):
        net = points.PointNetPlus(ELECTRODE_POSITIONS, 1, 3, layers_of)
        yield name, Standardised(net), ELECTRODES
    for name, members in (("residual network", 1), ("residual networks, mean of three", 3)):
        nets = [Standardised(ResidualLayers(38, 3), 38, 3) for _ in range(members)]
        yield name, ElectrodeNet(nets, REST, MIRROR_AXES), ELECTRODES
    attention = Standardised(Flat(ours.ElectrodeAttention(3)), 38, 3)
    yield "attention over electrodes", ElectrodeNet([attention], REST, MIRROR_AXES), ELECTRODES


def of_fields(nodes: int, modes: int) -> Iterator[tuple[str, nn.Module, int]]:
    """Networks from electrodes to the 128 nodes or to modes, without the modes themselves."""
    for name, layers in (
        ("PointNet++ (the paper's)", points.PUBLISHED),
        ("PointNet++, radii 6 and 10 mm", points.FITTED),
    ):
        net = points.PointNetPlus(ELECTRODE_POSITIONS, 1, 3 * nodes, layers)
        yield name, Standardised(net, ELECTRODES, 3 * nodes), ELECTRODES
    yield "Narang 2021: latent projection", Projected(ELECTRODES, modes, to_mesh=True), ELECTRODES
    signs = np.ones(modes, np.float32)
    for name, members in (("network to modes", 1), ("networks to modes, mean of three", 3)):
        nets = [MembersConfig().member(38, modes) for _ in range(members)]
        yield name, ElectrodeNet(nets, REST, signs), ELECTRODES


def of_synthesis(places: np.ndarray, modes: int) -> Iterator[tuple[str, nn.Module, int]]:
    """Networks from the 128 nodes, from features or from modes to electrodes."""
    width = 3 * len(places)
    net = points.PointNetPlus(places, 3, ELECTRODES, points.FITTED_NODES)
    yield "PointNet++ (the paper's)", Standardised(net, width, ELECTRODES), width
    yield "Ruppel 2019: network A", ruppel.network_a(ELECTRODES), 0
    yield "Ruppel 2019: network B", ruppel.network_b(ELECTRODES), 0
    pointnet = points.PointNet(places, ELECTRODES)
    yield "Zapata 2021: PointNet", Standardised(pointnet, width, ELECTRODES), width
    yield "Narang 2021: latent projection", Projected(modes, ELECTRODES, to_mesh=False), modes


def milliseconds(model: bytes) -> float:
    """Median time of one frame on one thread [ms]."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    given = session.get_inputs()[0]
    row = np.zeros((1, given.shape[1]), np.float32)
    taken = []
    for _ in range(RUNS):
        began = time.perf_counter()
        session.run(None, {given.name: row})
        taken.append(time.perf_counter() - began)
    return float(1e3 * np.median(taken[RUNS // 10 :]))


def measured(task: str, name: str, net: nn.Module, inputs: int) -> dict[str, Any]:
    """A row of the table of networks."""
    width = inputs or int(net.get_buffer("input_mean").shape[0])
    model = onnx_bytes(net.eval(), "given", torch.zeros(4, width), ["estimate"])
    return {
        "task": task,
        "name": name,
        "weights": sum(each.numel() for each in net.parameters()),
        "ms": milliseconds(model),
    }


def shipped() -> Iterator[dict[str, Any]]:
    """A row of the table of bundles, for each that ships."""
    for path in sorted(MODELS.glob("*/*/manifest.json")):
        manifest = json.loads(path.read_text(encoding="utf-8"))
        folder = path.parent
        content = (folder / "model.onnx").read_bytes()
        graph = onnx.load_from_string(content)
        yield {
            "name": manifest["name"],
            "version": manifest["version"],
            "task": manifest["task"],
            "megabytes": sum(each.stat().st_size for each in folder.iterdir()) / 1e6,
            "opset": manifest["opset"],
            "parity": manifest["metrics"]["parity_max"],
            "ms": milliseconds(content),
            "operators": sorted({node.op_type for node in graph.graph.node}),
        }


def main() -> None:
    """Measure and write both files."""
    data = read_mixed(SAMPLE)
    places = data.mesh.nodes[data.mesh.subset]
    bundles = list(shipped())
    modes = int(
        json.loads(
            next((MODELS / "field-twin").glob("*/manifest.json")).read_text(encoding="utf-8")
        )["metrics"]["modes"]
    )
    networks = [
        measured(task, *each)
        for task, some in (
            ("features", of_features()),
            ("field", of_fields(len(places), modes)),
            ("synthesis", of_synthesis(places, modes)),
        )
        for each in some
    ]
    values = {
        "schema": "palpate.networks 1",
        "machine": machine(),
        "onnxruntime": onnxruntime.__version__,
        "bundles": bundles,
        "networks": networks,
    }
    RESULTS.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(values), encoding="utf-8")
    sys.stdout.write(f"wrote {RESULTS} and {PAGE}\n")


def page(values: dict[str, Any]) -> str:
    """The page of the JSON, with the times of an earlier run on a faster host."""
    earlier = json.loads(FASTER_HOST.read_text(encoding="utf-8"))["bundles"]
    faster = {one["name"]: f"{one['ms']:.2f}" for one in earlier}
    host = values["machine"]
    bundles = markdown_table(
        (
            "bundle",
            "task",
            "MB",
            "ms a frame",
            "faster host",
            "goal",
            "parity",
            "opset",
            "operators",
        ),
        [
            (
                f"`{one['name']}` {one['version']}",
                one["task"],
                f"{one['megabytes']:.1f}",
                f"{one['ms']:.2f}",
                faster.get(one["name"], ""),
                f"{GOAL_MS[one['task']]:g}",
                f"{one['parity']:.0e}",
                str(one["opset"]),
                " ".join(one["operators"]),
            )
            for one in values["bundles"]
        ],
    )
    networks = markdown_table(
        ("task", "network", "weights", "ms a frame"),
        [
            (one["task"], one["name"], f"{one['weights']:,}", f"{one['ms']:.3f}")
            for one in values["networks"]
        ],
    )
    total = sum(one["megabytes"] for one in values["bundles"])
    return (
        "# What each network costs\n\n"
        "Made by `python docs/make_networks.py`: ONNX Runtime"
        f" {values['onnxruntime']} on one thread, one frame after the other, median; {host['cpus']}"
        f" cores, {host['cpu']}.\n\n"
        "## Bundles that ship\n\n"
        f"{total:.1f} MB in all (goal 25). Parity: largest difference between torch and ONNX"
        " Runtime, over what is allowed ([ADR 8](../adr/0008-bundle.md)). Weights are stored in"
        " half precision, and take twice the room in memory: a processor whose caches do not hold"
        " them reads them for each frame. *Faster host*: an earlier run with versions of the same"
        " size.\n\n"
        f"{bundles}\n"
        "## Networks of the study\n\n"
        "Networks whose output or input is coefficients of modes are counted without the modes. Our"
        " synthesis network is `synthesis-twin`, above.\n\n"
        f"{networks}"
    )


if __name__ == "__main__":
    main()
