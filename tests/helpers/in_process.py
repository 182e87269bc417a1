"""Calls of tasks in this process."""

from plumbline.processes import worker_pool
from plumbline.processes.worker_pool import Executor, Limits


class InProcessWorkers(Executor):
    """Stands for the pool of workers: the same calls in this process, so that hundreds of runs are quick."""

    capacity = 1

    def __init__(self, jobs, limits=None):
        self.limits = limits or Limits()

    def start(self, task):
        self.task = task

    def collect(self):
        return [(self.task, worker_pool.run_task(self.task))]
