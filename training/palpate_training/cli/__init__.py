"""Commands of this room: ``palpate train ...`` and ``palpate data ...``, mounted by deploy."""

from __future__ import annotations

import typer

from palpate_training.cli import data, experiment, report, train

train_app = typer.Typer(
    no_args_is_help=True, help="Train networks and write model bundles.", rich_markup_mode=None
)
train_app.command("force-real")(train.train_force_real)
train_app.command("transfer")(train.train_transfer)
train_app.command("population")(train.train_population_command)
train_app.command("line")(train.train_line)
train_app.command("features")(train.train_features_command)
train_app.command("field")(train.train_field)
train_app.command("synthesis")(train.train_synthesis)
train_app.command("all")(train.train_all)
train_app.command("report")(report.train_report)
train_app.command("upgrade")(train.train_upgrade)
train_app.command("location")(train.train_location)
train_app.command("intervals")(train.train_intervals)
train_app.command("evaluate")(report.train_evaluate)

data_app = typer.Typer(
    no_args_is_help=True, help="Make data sets and look into them.", rich_markup_mode=None
)
data_app.command("ingest-lasa")(data.data_ingest_lasa)
data_app.command("ingest-record")(data.data_ingest_record)
data_app.command("register")(experiment.data_register)
data_app.command("ingest")(experiment.data_ingest)
data_app.command("inspect")(data.data_inspect)
data_app.command("import")(data.data_import)
data_app.command("export")(data.data_export)
data_app.command("shrink")(data.data_shrink)
data_app.command("join")(data.data_join)
data_app.command("features")(data.data_features)
data_app.command("figures")(data.data_figures)
