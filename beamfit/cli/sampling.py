"""The options by which every command samples, and what it then shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from beamfit.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from beamfit.sampling.posterior import Posterior

__all__ = ["Sampling", "print_posterior", "sampling_options"]


class Sampling(NamedTuple):
    """What the options say.

    Attributes
    ----------
    wanted : bool
        Whether to sample.
    store : str or None
        File to keep the chain in.
    seed : int
        Of the random numbers.
    """

    wanted: bool
    store: str | None
    seed: int

    def check(self) -> None:
        """Find out before anything is computed whether the store could be written.

        Raises
        ------
        InputError
            If there is a store and no sampling, or no place for it.
        """
        if self.store is None:
            return
        if not self.wanted:
            raise InputError("--store without --sample", "--sample, which fills the store")
        from beamfit.sampling.store import check_place

        check_place(self.store)

    def options(
        self, command: str, inputs: Mapping[str, str | None], *, progress: bool
    ) -> dict[str, Any]:
        """Arguments for the `sample` of a fit."""
        from beamfit.sampling.store import Provenance

        source = Provenance(command, dict(inputs))
        return {
            "seed": self.seed,
            "store": self.store,
            "provenance": source,
            "progress": progress,
        }


def sampling_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --sample, --store and --seed; the command gets them as sample, store and seed."""
    for option in (
        click.option(
            "--seed",
            type=click.IntRange(0, 2**32 - 1),
            default=1,
            show_default=True,
            help="Of all random numbers: draws, starts of networks.",
        ),
        click.option(
            "--store",
            type=click.Path(),
            metavar="FILE.h5",
            default=None,
            help="Keep the draws of --sample (emcee's HDF5 layout); goes on from an earlier run.",
        ),
        click.option(
            "--sample",
            is_flag=True,
            help="Draw from the posterior: credible intervals, correlations, predictions.",
        ),
    ):
        command = option(command)
    return command


def print_posterior(console: Console, title: str, posterior: Posterior) -> None:
    """Show intervals, verdict and diagnostics."""
    from beamfit.cli.terminal import plain_table, verdict_text

    found, table = posterior.table(), plain_table(f"\n{title}")
    for name in found.header:
        table.add_column(name, no_wrap=True)
    for row in found.rows:
        table.add_row(*row)
    console.print(table)
    console.print(verdict_text("posterior", posterior.status, posterior.message))
