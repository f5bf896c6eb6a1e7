"""glTF in and out: Gaussians as points of a mesh, as KHR_gaussian_splatting describes them."""
