"""A number with its error and unit."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beamfit.errors import InputError, Status

__all__ = ["Quantity", "Status", "display_unit", "percent", "relative_change"]

# Half-width of the central 95 % of a normal distribution, in standard deviations.
NORMAL_REACH = 1.96
HOUR = 3600.0  # s
# Factors and letters of the unit prefixes.
_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"), (1e-12, "p"))
# A value and error are written with a power of ten if the error has more digits than this before
# the decimal point.
MAX_DIGITS = 4
# Units of `Quantity.to`, with their dimension and size in SI; those of the second line take
# prefixes.
_SIZES = {"min": ("s", 60.0), "h": ("s", HOUR), "d": ("s", 24 * HOUR), "G": ("T", 1e-4)}
_SIZES |= {u: (u, 1.0) for u in ("m", "s", "A", "eV", "V", "Pa", "rad", "T")}
_SCALES = {"p": 1e-12, "n": 1e-9, "µ": 1e-6, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}


@dataclass(frozen=True, repr=False)
class Quantity:
    """A value, its standard error and its unit.

    Parameters
    ----------
    value : float
        In SI.
    error : float or None
        Half of the central 68 % interval; None if the data do not determine the value.
    unit : str
        SI unit, "1" for a pure number.
    error_raw : float or None
        Error propagated from the stated errors of the data alone.
    interval_95 : tuple of float, or None
        Central 95 % interval. If omitted, it is the value ± 1.96 errors, as for a normal
        distribution, or None without an error. A value that the data do not determine may still
        have a limit here.

    Examples
    --------
    >>> print(Quantity(0.70468e-6, 0.0156e-6, "m"))
    0.705 ± 0.016 µm
    >>> Quantity(0.0, 1.0, "1").interval_95
    (-1.96, 1.96)
    >>> print(Quantity(4.1e-8, None, "m"))
    41 nm (not determined)
    >>> print(Quantity(-1e-9, 2.0, "MeV/m²"))
    0.0 ± 2.0 MeV/m²
    >>> emittance = Quantity(0.70468e-6, 0.0156e-6, "m")
    >>> float(emittance), emittance.nominal_value, emittance.std_dev
    (7.0468e-07, 7.0468e-07, 1.56e-08)
    """

    value: float
    error: float | None
    unit: str
    error_raw: float | None = None
    interval_95: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.interval_95 is None and self.error is not None:
            reach = NORMAL_REACH * self.error
            object.__setattr__(self, "interval_95", (self.value - reach, self.value + reach))

    @classmethod
    def reaching(
        cls, value: float, error: float, unit: str, raw: float | None, reach: float
    ) -> Quantity:
        """Make a quantity whose 95 % interval is the value ± `reach`.

        Examples
        --------
        >>> Quantity.reaching(10.0, 1.0, "m", None, 4.0).interval_95
        (6.0, 14.0)
        """
        return cls(value, error, unit, raw, (value - reach, value + reach))

    def __float__(self) -> float:
        return float(self.value)

    @property
    def nominal_value(self) -> float:
        """The value, under its name in the package uncertainties, for
        ``ufloat(q.nominal_value, q.std_dev)``. This ignores correlations of quantities of one fit.
        """
        return float(self.value)

    @property
    def std_dev(self) -> float:
        """The error, under its name in the package uncertainties; NaN if there is none."""
        return math.nan if self.error is None else float(self.error)

    def to(self, unit: str) -> Quantity:
        """Convert to another unit.

        Parameters
        ----------
        unit : str
            Such as "µm" (or "um"), "mm mrad", "1/h", "d".

        Raises
        ------
        InputError
            If the unit has another dimension.

        Examples
        --------
        >>> Quantity(7e-7, 1e-8, "m").to("um").value, Quantity(48.0, 2.4, "h").to("d").value
        (0.7, 2.0)
        >>> print(Quantity(5e-6, 1e-7, "1/s").to("1/h"))
        0.01800 ± 0.00036 1/h
        """
        (own, kind), (wanted, other) = _size(self.unit), _size(unit)
        if kind != other:
            raise InputError(f"{self.unit} in the unit '{unit}'", f"a unit of {self.unit}")
        factor = own / wanted
        error, raw = (None if e is None else e * factor for e in (self.error, self.error_raw))
        ends = self.interval_95 and (self.interval_95[0] * factor, self.interval_95[1] * factor)
        return Quantity(self.value * factor, error, unit, raw, ends)

    def open(self) -> Quantity:
        """Return the value without error and interval.

        Examples
        --------
        >>> print(Quantity(2.0, 0.1, "s").open())
        2 s (not determined)
        """
        return Quantity(self.value, None, self.unit)

    @property
    def determined(self) -> bool:
        """True if value and error are finite."""
        return self.error is not None and math.isfinite(self.error) and math.isfinite(self.value)

    @property
    def relative(self) -> float | None:
        """Error over value, or None."""
        return None if self.error is None or self.value == 0 else self.error / abs(self.value)

    @property
    def interval_words(self) -> str | None:
        """The 95 % interval as text, in the unit of the printed value; None without one.

        Examples
        --------
        >>> Quantity(7e-7, 1e-8, "m", None, (6.8e-7, 7.2e-7)).interval_words
        '0.68 to 0.72 µm'
        """
        if self.interval_95 is None:
            return None
        factor, unit = self._prefix()
        low, high = (end / factor for end in self.interval_95)
        return f"{low:.4g} to {high:.4g} {unit}".rstrip()

    def to_json(self) -> dict[str, float | str | list[float | None] | None]:
        """Give the object of the JSON contract; numbers that are not finite are null."""
        fields = {"value": self.value, "error": self.error, "error_raw": self.error_raw}
        finite = {k: v if v is not None and math.isfinite(v) else None for k, v in fields.items()}
        ends = [end if math.isfinite(end) else None for end in self.interval_95 or ()]
        interval = ends if any(end is not None for end in ends) else None
        return {**finite, "unit": self.unit, "interval_95": interval}

    def __str__(self) -> str:
        factor, unit = self._prefix()
        end = f" {unit}" if unit else ""
        if not math.isfinite(self.value):
            return "not determined"
        value = self.value / factor
        if self.error is None or not math.isfinite(self.error):
            return f"{value + 0.0:.3g}{end} (not determined)"
        error = self.error / factor
        places, power = 3 if error == 0 else 1 - math.floor(math.log10(error)), 0
        if max(abs(value), error) < 1e-3 or abs(value) >= 1e5 or error >= 10**MAX_DIGITS:
            power = math.floor(math.log10(max(abs(value), error) or 1.0))
            value, error, places = value / 10**power, error / 10**power, places + power
        value, digits = round(value, max(places, 0)) + 0.0, f".{max(places, 0)}f"  # no -0.0
        said = f"{value:{digits}} ± {error:{digits}}"
        return f"({said})e{power:+03d}{end}" if power else f"{said}{end}"

    def __repr__(self) -> str:
        return f"<Quantity {self}>"

    def _repr_html_(self) -> str:
        return str(self).replace("^2", "<sup>2</sup>")

    def _prefix(self) -> tuple[float, str]:
        return display_unit(
            max(abs(self.value), self.error or 0.0) if self.value else 0.0, self.unit
        )


def _size(unit: str) -> tuple[float, dict[str, int]]:
    """Return the size of a unit in SI, and its dimensions with their powers."""
    above, _, below = unit.replace("²", "^2").partition("/")
    factor, powers = 1.0, dict[str, int]()
    for part, sign in ((above, 1), (below, -1)):
        for word in part.strip("() ").replace("·", " ").split():
            name, _, power = word.partition("^")
            if name == "1":
                continue
            kind, size = _named(name)
            each = sign * (int(power) if power.isdigit() else 1)
            factor *= size**each
            powers[kind] = powers.get(kind, 0) + each
    return factor, {kind: power for kind, power in powers.items() if power}


def _named(name: str) -> tuple[str, float]:
    """Return dimension and size of a single unit; an unknown unit is its own dimension."""
    if name in _SIZES:
        return _SIZES[name]
    scale, base = _SCALES.get(name[:1]), _SIZES.get(name[1:])
    return (base[0], scale * base[1]) if scale and base else (name, 1.0)


def percent(share: float, digits: int = 2, sign: str = "") -> str:
    """Write a share in per cent, never as a power of ten.

    Examples
    --------
    >>> percent(0.0321), percent(96.4, sign="+"), percent(-0.0)
    ('3.2 %', '+9640 %', '0 %')
    """
    value = 100 * share
    if value == 0 or not math.isfinite(value):
        return "0 %" if value == 0 else "-"
    places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:{sign}.{places}f} %"


def relative_change(share: Quantity) -> str:
    """Write a relative change with its error, in per cent.

    Examples
    --------
    >>> relative_change(Quantity(0.2, 0.0057, "1"))
    '+20 ± 0.6 %'
    """
    return f"{percent(share.value, sign='+').removesuffix(' %')} ± {percent(share.error, 1)}"


def display_unit(size: float, unit: str) -> tuple[float, str]:
    """Choose nm, µm, mm or m for a length, and s for a time in hours below a minute.

    Parameters
    ----------
    size : float
        Magnitude in the SI unit.
    unit : str
        The SI unit, "1" for a pure number.

    Returns
    -------
    (float, str)
        Divisor, and the unit to write.

    Examples
    --------
    >>> display_unit(7e-7, "m")
    (1e-06, 'µm')
    >>> print(Quantity(0.005, 0.0001, "h"))
    18.00 ± 0.36 s
    """
    if unit == "h" and 0 < size < 60 / HOUR:
        return 1 / HOUR, "s"
    if unit != "m" or size == 0:
        return 1.0, "" if unit == "1" else unit
    factor, prefix = next((p for p in _PREFIXES if size >= 0.1 * p[0]), _PREFIXES[-1])
    return factor, prefix + unit
