"""Splitting for large view graphs: ShapeFit and LUD by ADMM with the scalar graph Laplacian.

edges              the proximal step, fused into one pass over the edges
anderson           acceleration of the iteration
linear             the Laplacian solve: Cholesky where it fits, conjugate gradients elsewhere
engine             the iteration that both programs share
split_then_newton  ShapeFit to a proven gap
lud                LUD
"""
