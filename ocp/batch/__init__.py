"""Many plans: tasks that are data, done by processes or a Dask cluster, results kept in a folder, each once."""

from ocp.batch.run import run_batch
from ocp.batch.table import Batch, BatchError, Result, read_batch
from ocp.batch.worker import kept

__all__ = ["Batch", "BatchError", "Result", "kept", "read_batch", "run_batch"]
