"""What accuracy costs in time: meters, sweeps over knobs against a reference, and the Pareto set.

A sweep is the data behind every work-precision diagram and every preset (docs/architecture.md).
"""

from ahoy_core.cost.machine import machine
from ahoy_core.cost.meter import Bill, Meter
from ahoy_core.cost.sweep import Measurement, Spread, pareto, read_jsonl, sweep, write_jsonl

__all__ = ["Bill", "Measurement", "Meter", "Spread", "machine", "pareto", "read_jsonl", "sweep", "write_jsonl"]
