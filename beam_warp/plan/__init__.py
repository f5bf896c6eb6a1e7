"""How is long work carried out? As a graph of steps, by one process or many, on one machine or several."""
