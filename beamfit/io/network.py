"""Networks in files of their own, in the report's XML form."""

from __future__ import annotations

import os

from beamfit.greybox.mlp import MLP
from beamfit.io.files import read_text
from beamfit.language.network import format_network, parse_network
from beamfit.writing import write_atomically


def read_network(path: str | os.PathLike[str]) -> MLP:
    """Read a network from a file.

    Parameters
    ----------
    path : path
        An XML file in UTF-8.

    Returns
    -------
    MLP

    Raises
    ------
    InputError
        If the file cannot be read or is not a network.
    """
    return parse_network(read_text(path), path)


def write_network(path: str | os.PathLike[str], net: MLP) -> None:
    """Write a network to a file, whole or not at all.

    Parameters
    ----------
    path : path
        Replaced if it exists.
    net : MLP
        The network.
    """
    write_atomically(path, format_network(net).encode())
