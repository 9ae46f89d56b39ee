"""Commands of this room: ``palpate train ...`` and ``palpate data ...``, mounted by deploy."""

from __future__ import annotations

import typer

from palpate_training.cli import data, experiment, train

train_app = typer.Typer(
    no_args_is_help=True, help="Train networks and write model bundles.", rich_markup_mode=None
)
for name, command in (
    ("force-real", train.train_force_real),
    ("features", train.train_features_command),
    ("field", train.train_field),
    ("synthesis", train.train_synthesis),
    ("twin", train.train_twin),
):
    train_app.command(name)(command)

data_app = typer.Typer(
    no_args_is_help=True, help="Make data sets and look into them.", rich_markup_mode=None
)
for name, command in (
    ("ingest-lasa", data.data_ingest_lasa),
    ("ingest-record", data.data_ingest_record),
    ("register", experiment.data_register),
    ("ingest", experiment.data_ingest),
    ("inspect", data.data_inspect),
    ("export", data.data_export),
    ("features", data.data_features),
    ("figures", data.data_figures),
):
    data_app.command(name)(command)
