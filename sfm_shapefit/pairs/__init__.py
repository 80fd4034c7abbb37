"""Matches and known rotations to one direction per image pair, with its support and uncertainty.

With both rotations known, a match gives two unit rays a, b in world axes, and the baseline
d = C_i - C_j lies in their plane: <a x b, d> = 0. The residual of a match is its Sampson error,

    r = <a x b, d> / (omega sqrt(|a x d|^2 + |b x d|^2)),    omega = angle of one pixel,

the distance in pixels, to first order, that both image points must move for the rays to meet. The
direction minimizes sum v rho(r) with the Geman-McClure kernel rho: two matches give a hypothesis
(a1 x b1) x (a2 x b2), and the best of many by truncated squares starts Gauss-Newton steps on the sphere.
The kernel is 4 standard deviations of the noise wide, which is measured by the median of the residuals
near the direction, so that it does not matter how many matches are elsewhere. v = 1 but for
matches with far more parallax than nearly all others (a Mallows weight): what agrees by chance has a long
parallax, and with it a long lever. The sign is the one that puts the points in front of both cameras.

The covariance is A^-1 B A^-1 in the plane orthogonal to d, with A the expected curvature of the cost,
cleared of what noise alone puts into it, and B the variance of its slope. B carries the factor m / (m - 5)
of m inliers: two unknowns are fitted, and the mean of an error squared over a noise squared with
m - 2 degrees of freedom is another (m - 2) / (m - 4) too large; the rest is the median's.

A pair is a rival to itself if the matches off its direction agree on a second one: repeated facades
and moving things look like that.

Sources: Sampson error and cheirality: Hartley and Zisserman, "Multiple View Geometry", 2nd ed.,
sections 11.4.3 and 21; truncated-squares consensus: Torr and Zisserman, "MLESAC", CVIU 2000;
Geman-McClure weights: Zhang, "Parameter estimation techniques", IVC 1997, table 1; the covariance of an
M-estimator and weights by leverage: Huber and Ronchetti, "Robust Statistics", 2nd ed., sections 3.2 and 7.9;
the bias of noise in the normals: Kanatani, "Statistical Optimization for Geometric Computation", 1996, ch. 9.
"""
