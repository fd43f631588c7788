"""Plain SINDy, today's practice beside the diagnosis, names what it can name."""

from concealed_cases import damped_duffing

from experiments._concealed_today import practised


def test_pysindy_finds_a_clear_damping():
    """Where everything is read and little disturbs, plain SINDy names the damping exactly."""
    found = practised(*damped_duffing(), ["sindy", "ensemble"])
    assert found["sindy"]["exact"] and found["ensemble"]["exact"]
    assert found["sindy"]["holdout"] < found["none"]["holdout"]
