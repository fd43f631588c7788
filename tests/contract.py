"""Section 4 of the contract as a check: what `diagnosis.json` must hold, from its text alone."""

import json
import math

FAMILY = {
    "viscous_damping": "dissipation", "quadratic_drag": "dissipation", "coulomb_friction": "dissipation",
    "relative_damping": "dissipation", "self_excitation": "activity", "constant_force": "conservative",
    "linear_stiffness": "conservative", "quadratic_stiffness": "conservative", "cubic_stiffness": "conservative",
    "coupling_spring": "conservative", "contact_stop": "conservative", "central_correction": "conservative",
    "gyroscopic_coupling": "gyroscopic", "periodic_forcing": "forcing", "impulse": "forcing",
    "parametric_modulation": "time variation", "parameter_drift": "time variation",
    "regime_change": "time variation", "hidden_oscillator": "hidden degree of freedom",
    "parameter_error": "calibration", "sensor_noise": "sensor", "sensor_bias": "sensor", "sensor_gain": "sensor",
    "sensor_drift": "sensor", "sensor_delay": "sensor", "sensor_outliers": "sensor", "unnamed_force": "any",
}  # fmt: skip
TOP = {
    "schema", "verdict", "probability", "log_bayes_factor", "location", "findings", "alternatives", "other",
    "family_probability", "parameters", "fit", "next_measurement", "warnings", "thinning", "converged", "version",
    "seed", "seconds",
}  # fmt: skip
LOCATION = {"kind", "targets", "recordings", "time_windows", "where"}
FINDING = {
    "effect", "target", "family", "recordings", "probability", "log_bayes_factor", "coefficients", "sentence",
}  # fmt: skip
FIT = {"holdout_rmse", "holdout_log_density", "process_noise_sd", "noise_sd"}


def strict_json(text):
    """The document; NaN, Infinity and doubled keys are refused, as strict JSON has neither."""

    def refuse(word):
        raise AssertionError(f"{word} is no JSON number")

    def once(pairs):
        keys = [key for key, _ in pairs]
        assert len(keys) == len(set(keys)), f"a key twice among {keys}"
        return dict(pairs)

    return json.loads(text, parse_constant=refuse, object_pairs_hook=once)


def number(value, least=-math.inf, most=math.inf):
    """A finite JSON number within bounds."""
    assert type(value) in (int, float) and math.isfinite(value), f"{value!r} is no finite number"
    assert least <= value <= most, f"{value} is not between {least} and {most}"


def check_document(document, columns, momenta, recordings=1, held_out=True):
    """`AssertionError` where the document is not as section 4 words it."""
    assert set(document) >= TOP, f"missing: {TOP - set(document)}"
    assert document["schema"] == "symplearn.diagnosis/1"
    assert document["verdict"] in ("consistent", "mismatch", "unexplained")
    number(document["probability"], 0, 1)
    _check_location(document["location"], recordings)
    for finding in document["findings"]:
        _check_finding(finding, recordings)
    _check_probabilities(document)
    _check_verdict(document)
    _check_fits(document, columns, momenta, held_out)
    assert isinstance(document["next_measurement"], str)
    assert all(isinstance(one, str) and one for one in document["warnings"])
    thinning = document["thinning"]
    assert set(thinning) >= {"rows", "used"} and 0 < thinning["used"] <= thinning["rows"]
    assert type(document["converged"]) is bool and type(document["seed"]) is int
    assert isinstance(document["version"], str)
    number(document["seconds"], 0)


def _check_location(location, recordings):
    assert set(location) >= LOCATION
    assert location["kind"] in ("dynamics", "sensor", "both", "none")
    assert all(isinstance(target, str) for target in location["targets"])
    assert set(location["recordings"]) <= set(range(1, recordings + 1))
    for window in location["time_windows"]:
        assert len(window) == (2 if recordings == 1 else 3), window
        for end in window:
            number(end)
        assert window[0] <= window[1]
        assert recordings == 1 or window[2] in location["recordings"]
    assert isinstance(location["where"], str) and location["where"]


def _check_finding(finding, recordings):
    assert set(finding) >= FINDING
    assert finding["family"] == FAMILY[finding["effect"]]
    assert isinstance(finding["target"], str | list) and finding["target"]
    assert finding["recordings"] and set(finding["recordings"]) <= set(range(1, recordings + 1))
    number(finding["probability"], 0, 1)
    number(finding["log_bayes_factor"])  # null belongs to `consistent`, which has no findings
    assert isinstance(finding["sentence"], str) and len(finding["sentence"]) > 20
    for value in finding["coefficients"].values():
        assert set(value) >= {"mean", "sd", "interval95"}
        low, high = value["interval95"]
        for one in (value["mean"], low, high):
            number(one)
        number(value["sd"], 0)
        assert low <= value["mean"] <= high


def _check_probabilities(document):
    rows = document["alternatives"]
    for row in rows:
        assert set(row) >= {"findings", "unexplained", "probability"}
        assert type(row["unexplained"]) is bool and not (row["unexplained"] and row["findings"])
        assert all(set(one) >= {"effect", "target"} and one["effect"] in FAMILY for one in row["findings"])
        number(row["probability"], 0, 1)
    number(document["other"], 0, 1)
    total = document["probability"] + document["other"] + sum(row["probability"] for row in rows)
    assert abs(total - 1) < 1e-3, f"probabilities add up to {total}"  # the contract's own tolerance
    reported = {(one["effect"], str(one["target"])) for one in document["findings"]}
    for row in rows:
        assert not row["findings"] or {(o["effect"], str(o["target"])) for o in row["findings"]} != reported
    assert set(document["family_probability"]) <= set(FAMILY.values())
    for value in document["family_probability"].values():
        number(value, 0, 1)


def _check_verdict(document):
    verdict, findings = document["verdict"], document["findings"]
    bare = {row["unexplained"]: row["probability"] for row in document["alternatives"] if not row["findings"]}
    as_it_is = document["probability"] if verdict == "consistent" else bare[False]
    assert (as_it_is >= 0.05) == (verdict == "consistent")
    assert bool(findings) == (verdict == "mismatch")
    if verdict == "consistent":
        assert document["location"]["kind"] == "none" and document["log_bayes_factor"] is None
        assert document["fit"]["after"] == document["fit"]["before"]
        assert document["parameters"]["after"] == document["parameters"]["before"]
    else:
        number(document["log_bayes_factor"])
        assert verdict == "mismatch" or document["log_bayes_factor"] == 0.0  # against itself
        assert document["location"]["targets"]
    if verdict == "mismatch":
        sensor = {one["family"] == "sensor" for one in findings}
        kind = "both" if len(sensor) == 2 else ("sensor" if True in sensor else "dynamics")
        assert document["location"]["kind"] == kind
        strengths = [one["log_bayes_factor"] for one in findings]
        assert strengths == sorted(strengths, reverse=True), "findings come strongest first"
        assert document["probability"] >= bare[True], "unexplained is likelier, yet an effect is named"


def _check_fits(document, columns, momenta, held_out):
    for when in ("before", "after"):
        fit, parameters = document["fit"][when], document["parameters"][when]
        assert set(fit) >= FIT
        if held_out:
            assert set(fit["holdout_rmse"]) == set(columns)
            for value in (*fit["holdout_rmse"].values(), fit["holdout_log_density"]):
                number(value)
            for value in fit["holdout_misfit"].values():
                number(value, 0)
        else:
            assert fit["holdout_rmse"] is None and fit["holdout_log_density"] is None
        assert set(fit["process_noise_sd"]) >= set(momenta) and set(fit["noise_sd"]) == set(columns)
        for value in (*fit["process_noise_sd"].values(), *fit["noise_sd"].values()):
            number(value, 0)
        for value in parameters.values():
            number(value["mean"])
            number(value["sd"], 0)
    assert set(document["parameters"]["before"]) == set(document["parameters"]["after"])
