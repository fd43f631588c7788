"""The rows in reading order."""

from ._row import Row

_DYNAMAX = ("dynamax",)

ROWS = (
    Row("henon_heiles", "likelihood and gradient, Henon-Heiles, n 20, 20 substeps, 11 parameters", _DYNAMAX),
    Row("henon_heiles_chains", "the same for 64 chains at once", _DYNAMAX),
    Row("henon_heiles_long", "Henon-Heiles, n 2000, 1 substep: value, and value with gradient", _DYNAMAX),
    Row("cherry", "Cherry's 34 monomials, Tao 8 x 0.05, n 21: value, and value with gradient", _DYNAMAX),
    Row("nssnn", "a network of width 32, n 1000: value with gradient", _DYNAMAX),
    Row("nssnn_batch", "16 such networks at once", _DYNAMAX),
    Row("one_value", "one value, Henon-Heiles, n 20, of filterpy as well", ("dynamax", "filterpy")),
    Row("gradient_memory", "memory of a gradient up to n 100,000, in processes of their own", _DYNAMAX),
    Row("growth_with_readings", "cost along the number of readings"),
    Row("growth_with_parameters", "cost of a reverse gradient along the number of parameters"),
    Row("growth_with_state", "cost along the size of the state (with --full to 402)"),
    Row("sampling", "posterior of Henon-Heiles to 400 effective draws, against corrected DRAM"),
    Row("sampling_cherry", "posterior of Cherry's 36 parameters to 400 effective draws, against corrected DRAM"),
    Row("stepping", "trajectories with their slopes, as a diagnosis steps them, by machine code and by XLA"),
    Row("diagnosing", "`symplearn demo` cold and warm, processes of their own"),
    Row("answering", "Henon-Heiles from a recording to the most probable model, warm"),
    Row("whole_loops", "what the option of XLA that symplearn sets does for dynamax, and for symplearn", _DYNAMAX),
    Row("card_chains", "10,000 chains at once on a graphics card, in double and single precision", on_card=True),
    Row("card_posterior", "the posterior of Henon-Heiles by 10,000 chains on a graphics card", on_card=True),
    Row("card_networks", "the sweep of Tao's example, 1,760 trainings, on a graphics card", on_card=True),
    Row("card_kalman", "the Kalman filter with all readings side by side on a graphics card", on_card=True),
    Row("card_diagnosis", "a diagnosis of a hundred recordings on a machine with a graphics card", on_card=True),
)


def row_of(name: str) -> Row | None:
    """The row of this name."""
    return next((row for row in ROWS if row.name == name), None)
