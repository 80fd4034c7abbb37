"""What every room uses: errors, arrays, kernels, settings, geometry, folders; knows nothing of cameras."""
