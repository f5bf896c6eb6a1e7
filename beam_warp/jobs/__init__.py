"""What every long job has: a store of finished frames, and a report."""
