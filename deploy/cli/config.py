"""`navaclq config`: what a run would be configured with."""

from __future__ import annotations

import sys

import typer

from deploy.cli import options

app = typer.Typer(help="Look at the configuration.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Look at the configuration."""


@app.command()
def show(
    preset: options.Preset = None,
    variant: options.Variant = None,
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    seed: options.Seed = None,
    as_json: options.Json = False,
) -> None:
    """Print the resolved configuration as TOML, or JSON."""
    resolved = options.configuration(preset, variant, config, settings, seed)
    if as_json:
        options.print_json(resolved.model_dump(mode="json"))
    else:
        sys.stdout.write(resolved.to_toml())
