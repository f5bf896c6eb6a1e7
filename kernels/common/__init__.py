"""What every family of kernels uses: launching, random streams, sums in a fixed order, and small maths."""
