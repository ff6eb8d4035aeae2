"""Benchmarks: what `navaclq bench` measures, each against its rivals or its limit in the same run."""
