"""The coarse motion of a subject: joints, the graph of their neighbours, and the Gaussians that they carry."""
