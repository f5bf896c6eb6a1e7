"""Delivery container b4d: a take in a static block and segments that decode alone; see ``docs/delivery.md``."""
