"""The potential well of two RF systems: how long the bunch is in it, and how high the bucket."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.ring import HarmonicCavity, Ring

# Where the density is computed: the main RF's bucket and a quarter more, in halves of its width,
# fifty times closer at the bunch than on average.
EVEN = np.linspace(-1.0, 1.0, 4097)
PHASES = 1.25 * EVEN * (0.02 + 0.98 * EVEN**2)
SPACING = 0.02 + 3 * 0.98 * EVEN**2


def length_and_height(ring: Ring, voltage: Array, cavity: HarmonicCavity) -> tuple[Array, Array]:
    """Rms bunch length and bucket height at zero current in a main and a harmonic RF system.

    Parameters
    ----------
    ring : Ring
        The ring; its `momentum_acceptance` and impedance are not used here.
    voltage : float
        Peak voltage of the main RF, V.
    cavity : HarmonicCavity
        The second system.

    Returns
    -------
    length, height : float
        Rms length, m, and momentum acceptance of the bucket; NaN where no beam is stored.

    Notes
    -----
    The energy spread is Gaussian, whatever the potential well, so the density along the bunch is
    exp(W/(2 pi h alpha_c sigma_delta² E0)) with W the integral of V1 sin(phi_1 + phi) +
    V_h sin(phi_h + n phi) - U0 over the RF phase phi: J. Haissinski, Nuovo Cimento 18B (1973) 72;
    A. Hofmann and S. Myers, CERN ISR-TH-RF/80-26 (1980). The bucket ends at the higher of the
    lowest densities on both sides.

    Examples
    --------
    A third-harmonic cavity without generator, near the flat potential:

    >>> from beamfit.io.ring import read_ring
    >>> from beamfit.lifetime.ring import HarmonicCavity
    >>> ring = read_ring("lattices/spear3_2003.toml")
    >>> length, _ = length_and_height(ring, 3.2e6, HarmonicCavity(3, 1.01e6, -0.11))
    >>> print(f"{1e3 * length:.1f} mm")
    16.7 mm
    """
    number, loss = cavity.number, ring.energy_loss
    main = jnp.pi - jnp.arcsin((loss - cavity.voltage * jnp.sin(cavity.phase)) / voltage)
    phase = PHASES * (2 * main - jnp.pi)
    work = (
        voltage * (jnp.cos(main) - jnp.cos(main + phase))
        + cavity.voltage / number * (jnp.cos(cavity.phase) - jnp.cos(cavity.phase + number * phase))
        - loss * phase
    )
    spread = ring.momentum_compaction * ring.energy_spread**2 * ring.energy
    log = work / (2 * jnp.pi * ring.harmonic * spread)
    middle = PHASES.size // 2
    ends = jnp.argmin(log[:middle]), middle + jnp.argmin(log[middle:])
    inside = (jnp.arange(PHASES.size) >= ends[0]) & (jnp.arange(PHASES.size) <= ends[1])
    top = jnp.max(jnp.where(inside, log, -jnp.inf))
    density = SPACING * jnp.where(inside, jnp.exp(jnp.where(inside, log - top, 0.0)), 0.0)
    mean = jnp.average(phase, weights=density)
    rms = jnp.sqrt(jnp.average((phase - mean) ** 2, weights=density))
    depth = top - jnp.maximum(log[ends[0]], log[ends[1]])
    length = rms * ring.circumference / (2 * jnp.pi * ring.harmonic)
    return length, ring.energy_spread * jnp.sqrt(2 * depth)
