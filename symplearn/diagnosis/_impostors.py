"""Effects that are taken for each other, and the recordings that unmask them."""

_STIFFNESSES = ("linear_stiffness", "quadratic_stiffness", "cubic_stiffness")
_DRAGS = ("viscous_damping", "quadratic_drag", "coulomb_friction")
OVER_TIME = ("parameter_drift", "regime_change", "parametric_modulation", "sensor_drift")
_LOSSES = (*_DRAGS, "relative_damping", "self_excitation")

# Two kinds of effects that are taken for each other, and the recording that tells them apart. The first pair that fits
# counts; {a} and {b} are the targets of the first and of the second kind.
UNMASK: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    (
        _DRAGS,
        _DRAGS,
        "a recording in which {a} starts at twice the amplitude and goes on until the motion has nearly died: the "
        "laws of friction differ most between fast and slow motion",
    ),
    (
        ("relative_damping",),
        _DRAGS,
        "a recording in which {a} move together, and one in which they move against each other: a damping between "
        "them leaves the common motion free",
    ),
    (
        ("self_excitation",),
        _LOSSES,
        "a recording from a very small start and one from a very large one: a self-excitation lets the small "
        "motion grow",
    ),
    (
        ("constant_force",),
        ("sensor_bias",),
        "a reading of {b} at a place known otherwise, or the apparatus turned round: a force changes sign, a bias "
        "does not",
    ),
    (
        ("constant_force", "sensor_bias"),
        ("quadratic_stiffness",),
        "a recording at a very different amplitude, and one at rest: a force and a bias stay, an uneven stiffness "
        "fades with the amplitude",
    ),
    (
        _DRAGS,
        ("sensor_bias", "constant_force"),
        "a longer recording, until the motion has died: a bias stays where a decay ends",
    ),
    (
        ("contact_stop",),
        (*_STIFFNESSES, "constant_force"),
        "two recordings of {a}, one that stays well inside the stop and one that runs far into it: a stop does "
        "nothing inside, a stiffness acts everywhere",
    ),
    (
        ("impulse",),
        ("contact_stop",),
        "a repeat of the same recording, several swings long: a stop is met again at the same place in every "
        "swing, a blow comes once",
    ),
    (
        ("parameter_error",),
        _STIFFNESSES,
        "a measurement of {a} by itself, on a scale or a test bench, or a recording at several amplitudes: a "
        "wrong value changes every term in which {a} stands, a stiffness only its own",
    ),
    (
        ("sensor_gain",),
        (*_STIFFNESSES, "parameter_error"),
        "a recording at half the amplitude, and the sensor of {a} held against a known place or angle: a gain "
        "scales both recordings alike, while what changes the motion changes its frequency",
    ),
    (
        _STIFFNESSES,
        _STIFFNESSES,
        "recordings of {a} at several amplitudes: how the frequency depends on the amplitude tells the powers apart",
    ),
    (
        ("coupling_spring",),
        _STIFFNESSES,
        "a recording in which {a} move together, and one in which they move against each other: a spring between "
        "them does nothing in the common motion",
    ),
    (
        ("gyroscopic_coupling",),
        ("central_correction", "coupling_spring", "relative_damping"),
        "the same start turned in both senses, and orbits of different size in the plane of {a}: a gyroscopic "
        "force changes sign with the direction of motion, a force that depends on place does not",
    ),
    (
        ("central_correction",),
        (*_STIFFNESSES, "coupling_spring"),
        "orbits of very different size: a central correction fades with distance, a spring grows",
    ),
    (
        ("regime_change",),
        ("impulse",),
        "a longer recording, or a second one from the same start some time after the event: a changed parameter "
        "stays changed, a blow leaves the laws as they were",
    ),
    (
        ("regime_change",),
        ("parameter_drift", "sensor_drift"),
        "a recording several times longer, or a second one from the same start a good while later: a drift has "
        "gone on by then, a sudden change has not",
    ),
    (
        ("impulse",),
        ("parameter_drift", "sensor_drift", "parametric_modulation"),
        "a second recording from the same start a good while later: a drift or a change shows from its first row "
        "on, a blow does not come back",
    ),
    (
        ("periodic_forcing",),
        ("hidden_oscillator",),
        "a recording at rest and one at another amplitude: a forcing keeps its size and its clock, a hidden "
        "oscillator answers in proportion to the motion",
    ),
    (
        ("periodic_forcing",),
        ("parametric_modulation",),
        "a recording at rest or at a small amplitude: a forcing stays, the change of a parameter fades with the motion",
    ),
    (
        ("periodic_forcing", "parametric_modulation", "hidden_oscillator"),
        ("parameter_drift", "sensor_drift", "regime_change"),
        "a recording over several of the supposed periods: what is periodic comes back, a drift or a sudden "
        "change does not",
    ),
    (
        ("hidden_oscillator",),
        ("parametric_modulation", *_LOSSES, *_STIFFNESSES),
        "a longer recording, over several beats: a hidden oscillator gives back the energy that it took, and its "
        "beat does not depend on the amplitude",
    ),
    (
        ("sensor_drift", "sensor_bias"),
        ("sensor_drift", "sensor_bias", "parameter_drift", "constant_force", "regime_change"),
        "a long recording at rest, with the sensor of {a} held against a known place or angle at its beginning "
        "and its end: only a drift of the sensor goes on there",
    ),
    (
        ("parameter_drift", "regime_change"),
        _LOSSES,
        "a second recording started later from the first amplitude: a changed parameter has moved the frequency "
        "from the first row on, a loss of energy begins anew",
    ),
    (
        ("sensor_delay",),
        (*_LOSSES, "hidden_oscillator"),
        "a recording of {a} under a known motion or beside a second sensor of known timing, and a free decay at "
        "another frequency: a delay takes no energy and shifts the phase in proportion to the frequency",
    ),
    (
        ("sensor_noise",),
        ("sensor_outliers",),
        "a thousand readings of {a} at rest: their histogram shows whether all scatter more or a few are far off",
    ),
    (
        ("sensor_gain",),
        ("sensor_bias",),
        "readings of {a} at two known places far apart: a bias is the same at both, a wrong scale is not",
    ),
)
# Where an effect shows best: for what no pair above is about.
SHOWS = {
    **dict.fromkeys(_DRAGS, "a free decay of {a} from a large amplitude until the motion has nearly died"),
    "relative_damping": "a free decay in which {a} move against each other",
    "self_excitation": "a start of {a} close to rest, long enough to see the motion grow or die",
    "constant_force": "a recording of {a} near rest, and the apparatus turned round",
    **dict.fromkeys(_STIFFNESSES, "recordings of {a} at several amplitudes"),
    "coupling_spring": "a recording in which only one of {a} is moved and the other one is free",
    "contact_stop": "a recording in which {a} runs far beyond the supposed place of the stop, slowly and fast",
    "central_correction": "orbits of {a} that come much closer to the centre",
    "gyroscopic_coupling": "the same start of {a} turned in both senses",
    "periodic_forcing": "a recording of {a} at rest, over several of the supposed periods",
    "impulse": "a repeat of the same recording: a blow does not come back",
    "parametric_modulation": "a recording over several of the supposed periods of {a}",
    "parameter_drift": "a second recording from the same start a good while later: {a} has drifted on by then",
    "regime_change": "a second recording from the same start some time after the change of {a}",
    "hidden_oscillator": "a recording of {a} over several beats, and a sensor on what may hang on it",
    "parameter_error": "a measurement of {a} by itself, on a scale or a test bench",
    "sensor_noise": "a recording of {a} at rest, which shows the noise alone",
    "sensor_outliers": "a long recording of {a} at rest, which shows the outliers alone",
    "sensor_drift": "a long recording of {a} at rest",
    "sensor_delay": "a recording of {a} beside a second sensor of known timing",
    **dict.fromkeys(("sensor_bias", "sensor_gain"), "readings of {a} at two known places far apart"),
    "unnamed_force": "recordings of {a} at other amplitudes and speeds",
}
