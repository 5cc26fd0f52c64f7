"""Run many tasks, given as plain data, in processes or on a Dask cluster, and store each result in a folder."""

from ocp.app.batch.engine import cached
from ocp.app.batch.result_store import Result
from ocp.app.batch.run import Batch, BatchError, read_batch, run_batch

__all__ = ["Batch", "BatchError", "Result", "cached", "read_batch", "run_batch"]
