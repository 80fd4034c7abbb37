"""Primal-dual Newton steps on the smoothed sum of norms, dual feasible at every iterate.

The norms of the program (`program`) are smoothed to rho_e = sqrt(||r_e||^2 + mu^2), and Newton's method
is applied to the optimality conditions of the smoothed program, written without a quotient:

    rho_e y_e = w_e r_e,    D^T y = lambda c,    <c, T> = kappa,        r_e = P_e (t_i - t_j)

Linearized at (T, y), with the block S_e made symmetric, a step dT and the dual y+ it leads to are

    y+_e = g_e + S_e P_e (dt_i - dt_j),    g_e = w_e r_e / rho_e
    S_e  = (w_e P_e - (y_e r_e^T + r_e y_e^T) / (2 rho_e)) / rho_e
    M dT = lambda+ c - D^T g,    <c, dT> = 0,                 M = D^T S D

S_e is positive definite across v_e, for ||y_e|| <= w_e and ||r_e|| < rho_e. With a = M^-1 c and
b = M^-1 D^T g the solution is lambda+ = <c, b> / <c, a>, dT = lambda+ a - b. Then D^T y+ = lambda+ c: the
dual stays feasible, and lambda is a bound at every iterate.

What makes it fast and safe:

- *Lifting.* M is singular along translations, and nearly so along T where the data are nearly exact. Neither
  direction occurs in dT, for it would change the centroid or <c, T>. So multiples of 1 1^T and c c^T
  are added to M: dT and lambda+ stay what they are, and the matrix is well conditioned.
- *Two duals.* y+ fulfils the equality, and divided by its excess max ||y+_e|| / w_e the ball too; the
  best bound proven so is kept. But the excess is that of one pair, and scaling sets all others back. So the
  steps go on from y+ clipped to its balls pair by pair: they need no equality, the next y+ fulfils it anew.
  With noise that saves a quarter of the factorizations. In the plane clipped duals can make M singular: after
  a cycle that leaves more than half of the gap the steps go on from the feasible dual, moved towards y+ as
  far as the ball allows or replaced by y+ / excess, whichever has the larger lambda.
- *A start near the optimum.* On dense graphs with many wrong directions a few reweighted least-squares
  problems (`irls_start`) save the first factorization and one or two more. On all others the steps begin at
  the least-squares locations, whose residuals are a feasible dual.
- *Steps with an old matrix.* After a step the conditions are evaluated anew and solved again with the factor
  in hand: g_e = y_e - (rho_e y_e - w_e r_e) / rho'_e, rho' and S from the factorization. It goes on while the
  last step gained more per unit of work than the cycle since the factorization did on average, and nearly
  halves the number of factorizations.

Source: Andersen, Christiansen, Conn, Overton, "An efficient primal-dual interior-point method for
minimizing a sum of Euclidean norms", SIAM J. Sci. Comput. 22 (2000), for the symmetrized step. Hintermueller,
Stadler, "An infeasible primal-dual algorithm for total bounded variation-based inf-convolution-type image
restoration", SIAM J. Sci. Comput. 28 (2006), for going on from a projected dual.
"""
