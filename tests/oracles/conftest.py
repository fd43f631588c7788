"""Warnings of the other packages themselves are theirs; what ours makes them warn of still fails a test."""


def pytest_configure(config):
    # dynamax needs TensorFlow Probability, which asks JAX for a name that JAX is about to drop.
    config.addinivalue_line("filterwarnings", "ignore::DeprecationWarning:tensorflow_probability")
