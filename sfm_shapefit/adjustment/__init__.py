"""Bundle adjustment: poses, points and lenses that explain the pixels best.

    minimize  1/2 sum_o rho(|r_o|^2) + 1/2 sigma^2 sum_f d_f^T Omega_f d_f,      rho(s) = c^2 log(1 + s / c^2)

over the centers C_f of the frames, their rotations (free, held, or weighted by a prior), the points X_p and,
if asked, focal lengths and distortion; r_o is the reprojection error in pixels (`problem` has the lenses), c
the scale of the Cauchy loss and sigma the noise of an observation, which gives priors their weight.

One step of Levenberg-Marquardt solves (H + mu diag(H)) step = -gradient (Marquardt 1963; mu by Nielsen 1999,
"Damping parameter in Marquardt's method"). In H the loss weighs a residual r by

    M = w (I - beta r r^T),        w = rho'(|r|^2) = 1 / (1 + |r|^2 / c^2),

with beta = 0 far from the minimum, where reweighted squares are a safe bound of the loss, and near it from
rho'' as far as M stays positive (Triggs et al. 2000, section 4.3): there, steps converge as those of plain
squares do. The gradient w r has no approximation in it. H is

    [ U    W^T ]   nodes: a frame (center, rotation vector), a lens
    [ W    V   ]   points: V is 3 x 3 blocks

and the points are eliminated, S = U - W^T V^-1 W (`schur`; Triggs et al. section 6, Hartley and Zisserman
2004, appendix 6). S has a block for each pair of nodes that see a point together. It is factored by LAPACK up
to 3,000 unknowns, by the sparse block Cholesky of `laplacian` beyond (`reduced_factor`). A factor that fails
raises mu.

Conventions. A rotation changes by R <- exp(w) R, w in camera axes. An observation behind its camera counts as
one that misses by the focal length and pulls at nothing. Fixed frames and held rotations come out to the
last bit; the gauge that nothing holds is that of the start (`gauge`). The answer is the same to the last bit
whatever the number of threads. Nothing here draws random numbers, reads or writes.

Sources: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000; Hartley and
Zisserman, "Multiple View Geometry", 2nd ed., 2004, appendix 6; Agarwal, Mierle et al., Ceres Solver, whose
loss and stopping rule are kept so that answers can be compared.
"""
