"""Elements of a beam line. Each is a frozen value with ``matrix(setting, energy)``.

The mathematics is in focusing.py; an element only defines strength, length and edges in each plane.
Positive k1 focuses x. The numbers of an element may be arrays of one shape: it then stands for as
many elements, and its matrix has that shape before (2, 3, 3).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.arrays import array_module, floats, value
from beamfit.optics.calibration import Calibration, FocusingStrength, IntegratedStrength
from beamfit.optics.focusing import focusing
from beamfit.particles import ELECTRON_MASS, beta_gamma

_BY_K1, _BY_K1L = FocusingStrength(), IntegratedStrength()


@value()
class TransferMatrix:
    """Linear map of both planes, uncoupled, with dispersion.

    Parameters
    ----------
    planes : Array
        Shape (..., 2, 3, 3), the x plane and the y plane, each acting on (u in m, u' in rad,
        δ = Δp/p).

    Examples
    --------
    >>> drift = Drift("D", 2.0).matrix()
    >>> float((drift @ drift).x[0, 1])
    4.0
    """

    planes: Array

    @property
    def x(self) -> Array:
        """Shape (..., 3, 3): ``x[..., 0, 1]`` is R12, ``x[..., 0, 2]`` is R16."""
        return self.planes[..., 0, :, :]

    @property
    def y(self) -> Array:
        """Shape (..., 3, 3): ``y[..., 0, 1]`` is R34, ``y[..., 0, 2]`` is R36."""
        return self.planes[..., 1, :, :]

    def __matmul__(self, earlier: object) -> TransferMatrix:
        """Compose with the map the beam meets first: (B @ A) is A, then B."""
        if not isinstance(earlier, TransferMatrix):
            return NotImplemented
        return TransferMatrix(self.planes @ earlier.planes)


# Positions of the focusing functions in a plane's matrix.
_COSINE = np.diag([1.0, 1.0, 0.0])
_SINE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
_SLOPE = _SINE.T
_LAST = np.diag([0.0, 0.0, 1.0])
_DISPERSION = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
_ANGLE = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
IDENTITY = TransferMatrix(np.stack([np.eye(3)] * 2))


def _thick(k: ArrayLike, length: ArrayLike, curvature: ArrayLike = 0.0) -> Array:
    """Constant focusing k (1/m²) and curvature h (1/m): u'' + k u = h δ, for any shape of k."""
    c, s, d = (f[..., None, None] for f in focusing(k, length))
    k, h = (floats(v)[..., None, None] for v in (k, curvature))
    straight = c * _COSINE + s * _SINE - k * s * _SLOPE + _LAST
    return straight + h * (d * _DISPERSION + s * _ANGLE)


def _kick(strength: ArrayLike) -> Array:
    """A thin lens: u' changes by -strength · u, strength in 1/m, for any shape."""
    return np.eye(3) - floats(strength)[..., None, None] * _SLOPE


def _both_planes(strength: ArrayLike) -> Array:
    """A strength in x and its opposite in y, along a last axis."""
    return floats(strength)[..., None] * np.array([1.0, -1.0])


@value("name")
class Drift:
    """A field-free length in m (report eq. 21).

    Examples
    --------
    >>> float(Drift("D1", 1.5).matrix().y[0, 1])
    1.5
    """

    name: str
    length: ArrayLike
    setting: ClassVar[None] = None

    def matrix(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> TransferMatrix:
        """Transfer matrix of the drift, the same in both planes."""
        return TransferMatrix(IDENTITY.planes + floats(self.length)[..., None, None, None] * _SINE)


@value("name")
class Quadrupole:
    """A quadrupole of constant gradient (report eqs 20 and 22).

    Parameters
    ----------
    name : str
        Its name in the lattice and in the scan's column headers.
    length : float
        Effective length in m.
    setting : float
        Default setting, in the calibration's unit.
    calibration : Calibration
        Converts settings to strength; k1 in 1/m² unless given.

    Examples
    --------
    >>> q = Quadrupole("Q", 0.1, setting=0.0)
    >>> bool((q.matrix().x == Drift("D", 0.1).matrix().x).all())
    True
    """

    name: str
    length: ArrayLike
    setting: ArrayLike = 0.0
    calibration: Calibration = _BY_K1

    def k1(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> Array:
        """Focusing strength in 1/m², positive in x, at a setting and an energy in MeV."""
        setting = self.setting if setting is None else setting
        return floats(self.calibration.k1l(setting, self.length, energy)) / self.length

    def matrix(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> TransferMatrix:
        """Transfer matrix at a setting (the element's own if None) and an energy in MeV."""
        both = _both_planes(self.k1(setting, energy))
        return TransferMatrix(_thick(both, floats(self.length)[..., None]))


@value("name")
class ThinLens:
    """A quadrupole of zero length: u' changes by -k1l · u in x, +k1l · u in y.

    Parameters
    ----------
    name : str
        Its name.
    setting : float
        Inverse focal length in 1/m, or an integrated gradient, depending on the calibration.
    calibration : Calibration
        `IntegratedStrength` or `IntegratedGradient`.

    Examples
    --------
    >>> ThinLens("L", 0.5).matrix().x[1, 0].item()
    -0.5
    """

    name: str
    setting: ArrayLike = 0.0
    calibration: Calibration = _BY_K1L
    length: ClassVar[float] = 0.0

    def matrix(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> TransferMatrix:
        """Transfer matrix at a setting (the element's own if None) and an energy in MeV."""
        setting = self.setting if setting is None else setting
        return TransferMatrix(_kick(_both_planes(self.calibration.k1l(setting, 0.0, energy))))


def hard_edge_slice(
    angle: ArrayLike, exit_edge: ArrayLike, momentum_ratio: ArrayLike
) -> tuple[Array, Array]:
    """Bend angle and exit edge angle of a slice of another momentum in the same fixed magnet.

    The slice enters on the reference axis, follows a circle of radius ρ·r through the uniform
    field and leaves where that circle meets the exit pole face, which stays where it is. With
    the pole face at ν = α - ψ_exit to the entrance, the exit angle α' solves
    sin(α' - ν) = (sin ψ_exit + sin ν)/r - sin ν, exactly.

    Parameters
    ----------
    angle : float
        Reference bend angle α, rad.
    exit_edge : float
        Exit pole-face angle ψ_exit, rad; positive defocuses the bend plane.
    momentum_ratio : float
        r = momentum of the slice over the reference momentum.

    Returns
    -------
    tuple of Array
        α' and ψ_exit' = ψ_exit + (α' - α), rad.

    Notes
    -----
    The report prints Δα = α(r - 1) (text after eq. 28). A stiffer slice is bent less, so the
    sign there is wrong: to first order Δα = -(r - 1)(sin ψ_exit + sin ν)/cos ψ_exit, which is
    -α(r - 1) only for a thin wedge. tests/optics/test_dipole_tracking.py tracks particles
    through the field and settles it. The report's tan ψ_exit + Δα is tan(ψ_exit + Δα) to
    first order.

    Examples
    --------
    >>> bend, _ = hard_edge_slice(angle=1.0, exit_edge=0.0, momentum_ratio=1.01)
    >>> bool(bend < 1.0)
    True
    """
    xp = array_module(angle, exit_edge, momentum_ratio)
    face = angle - exit_edge
    sine = (xp.sin(exit_edge) + xp.sin(face)) / momentum_ratio - xp.sin(face)
    at_exit = xp.arcsin(sine)
    return face + at_exit, at_exit


@value("name", "bend_plane", "mass")
class SectorDipole:
    """A hard-edged sector dipole with pole-face rotations, in both planes.

    The bend plane is edge · sector · edge with dispersion; the other plane is edge · drift ·
    edge, which is the matrix of report eqs 24-28 (eq. 27 with 1/ρ before the whole bracket;
    as printed its determinant is 0.82).

    Parameters
    ----------
    name : str
        Its name.
    radius : float
        Bending radius ρ in m.
    angle : float
        Bend angle α in rad.
    entrance_edge, exit_edge : float
        Pole-face rotations ψ in rad; positive focuses the plane across the bend. A bend in the
        opposite direction has negative radius and angle; its focusing edges are negative too.
    bend_plane : {"x", "y"}
        The plane that is bent.
    energy_offset : float
        E_slice/E_proj - 1, of total energies, of the slice that is transported.
    k1 : float
        Gradient in the magnet, 1/m², positive focuses x.
    energy : float, optional
        Total energy in MeV for which the magnet is set: radius and angle are those of E_proj =
        ``energy``. If None it is set for each beam.
    mass : float
        Rest energy of the particle in MeV.

    Notes
    -----
    The body solves u'' + (h² + k) u = h δ in the bend plane, u'' - k u = 0 across it; a
    rotated edge is a thin lens of strength ∓tan ψ/ρ (K. L. Brown, SLAC-75, wedge magnets).
    Both are tested against another program and against particles tracked through the field. Radii
    scale with momenta, p² = E² - m², not with energies.

    Examples
    --------
    >>> spec = SectorDipole("SPEC", 0.4, 1.0471975512, 0.0441568, 0.2354449, bend_plane="y")
    >>> [round(float(spec.matrix().x[0, j]), 6) for j in (0, 1)]
    [0.953729, 0.418879]
    """

    name: str
    radius: ArrayLike
    angle: ArrayLike
    entrance_edge: ArrayLike = 0.0
    exit_edge: ArrayLike = 0.0
    bend_plane: str = "x"
    energy_offset: ArrayLike = 0.0
    k1: ArrayLike = 0.0
    energy: ArrayLike | None = None
    mass: float = ELECTRON_MASS
    setting: ClassVar[None] = None

    @property
    def length(self) -> ArrayLike:
        """Length of the reference orbit in the magnet, m."""
        return self.radius * self.angle

    def momentum_ratio(self, energy: ArrayLike = 1.0) -> Array:
        """Ratio of the slice's momentum to the one the magnet is set for, p² = E² - m².

        A magnet that is set for each beam bends all beams alike.

        Examples
        --------
        >>> proton = SectorDipole("B", 1.0, 0.5, energy_offset=0.01, mass=938.27208943)
        >>> round(float(proton.momentum_ratio(988.27208943)), 3)
        1.097
        """
        offset, set_for = self.energy_offset, self.energy
        if set_for is None and array_module(offset) is np and not np.any(offset):
            return np.ones(np.shape(offset))
        reference = floats(energy if set_for is None else set_for)
        return beta_gamma(floats(energy) * (1.0 + offset), self.mass) / beta_gamma(
            reference, self.mass
        )

    def matrix(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> TransferMatrix:
        """Transfer matrix for a beam energy in MeV, about the slice's own orbit."""
        ratio = self.momentum_ratio(energy)[..., None]
        parts = (self.radius, self.angle, self.entrance_edge, self.exit_edge)
        radius, angle, entrance, exit_angle = (floats(v)[..., None] for v in parts)
        xp = array_module(*parts, ratio)
        angle, exit_angle = hard_edge_slice(angle, exit_angle, ratio)
        radius = radius * ratio
        h, length = 1.0 / radius, radius * angle
        # +1 in the bend plane, where the body focuses by h² and an edge defocuses.
        sign = np.array([1.0, -1.0] if self.bend_plane == "x" else [-1.0, 1.0])
        bent = sign > 0
        body = _thick(
            xp.where(bent, h**2, 0.0) + _both_planes(self.k1) / ratio,
            length,
            xp.where(bent, h, 0.0),
        )
        entry, leave = (_kick(-sign * h * xp.tan(edge)) for edge in (entrance, exit_angle))
        return TransferMatrix(leave @ body @ entry)


@value("name")
class Marker:
    """A named place of zero length.

    Examples
    --------
    >>> Marker("M").matrix().x.tolist() == np.eye(3).tolist()
    True
    """

    name: str
    length: ClassVar[float] = 0.0
    setting: ClassVar[None] = None

    def matrix(self, setting: ArrayLike | None = None, energy: ArrayLike = 1.0) -> TransferMatrix:
        """Return the identity in both planes."""
        return IDENTITY


@value("name")
class Screen(Marker):
    """A place where the beam size is measured.

    Parameters
    ----------
    name : str
        Its name, as in a scan's ``screen`` column.
    resolution : float
        Point-spread rms in m, which adds to every measured size in quadrature.

    Examples
    --------
    >>> Screen("OTR2", resolution=5e-6).resolution
    5e-06
    """

    resolution: ArrayLike = 0.0


Element = Drift | Quadrupole | ThinLens | SectorDipole | Marker | Screen
