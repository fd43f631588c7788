"""Scripts that make what ships or is shown: each is one command, and shares no code with what it tests."""
