"""Calls of tasks in this process."""

from plumbline.processes import worker_pool
from plumbline.processes.worker_pool import Executor, Limits


class InProcessWorkers(Executor):
    """Stands for the pool of workers, so that many runs are quick; of two tasks the last ends first."""

    capacity = 2

    def __init__(self, jobs=1, limits=None):
        self.limits, self.started, self.pending = limits or Limits(), [], []

    def start(self, task):
        self.started.append(task.key)
        self.pending.append(task)
        assert len(self.pending) <= self.capacity

    def collect(self):
        task = self.pending.pop()
        return [(task, worker_pool.run_task(task))]
