"""Studies of cost against error: plans, truth, tables, charts and pages."""
