"""Problems of arms in space: the capture of a tumbling body."""
