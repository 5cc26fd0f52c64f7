"""Many plans: tasks that are data, done by processes or a Dask cluster, results kept in a folder, each once."""

from ocp.app.batch.engine import cached
from ocp.app.batch.run import run_batch
from ocp.app.batch.table import Batch, BatchError, Result, read_batch

__all__ = ["Batch", "BatchError", "Result", "cached", "read_batch", "run_batch"]
