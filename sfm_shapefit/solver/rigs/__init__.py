"""ShapeFit over rigid groups: known offsets inside each, one unknown scale s for all of them.

With t = A x, x = (f, s) (`sfm_shapefit.graph.groups`), the program is

    minimize    R(A x) = sum_e w_e || P_e (t_i - t_j) ||      over the pairs between two groups
    subject to  L(A x) = <c, A x> = kappa,  sum_b f_b = 0,         c = D^T (w v)

It is as homogeneous and as convex as ShapeFit itself. Its Lagrangian, with y_e for the norms (||y_e|| <= w_e,
orthogonal to v_e, since ||P z|| = max <y, z> over these) and lambda for the constraint, is

    <y, D A x> - lambda (<c, A x> - kappa),

whose infimum over x is lambda kappa if  A^T D^T y = lambda A^T c  and minus infinity otherwise. So the dual
is

    maximize    lambda
    subject to  sum over the pairs that leave group b of signed y_e = lambda * the same of w_e v_e,  each b
                sum_e <y_e, o_i - o_j> = lambda sum_e w_e <v_e, o_i - o_j>                        (for s)
                <y_e, v_e> = 0,    ||y_e|| <= w_e

the balance at every camera summed over its group, and one equation more. For every x and every feasible pair
R(A x) - lambda L(A x) = sum_e (w_e ||r_e|| - <y_e, r_e>) >= 0: lambda bounds the objective of all locations
of these groups. Fewer locations are admitted than without groups, so the bound is at least as high.

An approximate y is repaired as in `certificate`: y' = y - S D A h with (A^T D^T S D A) h = A^T (D^T y -
lambda c), and divided by max(1, max_e ||y'_e|| / w_e); both keep the equality, which is homogeneous. lambda
is what makes <q, h> = 0 for the pinned pair's row q (see `reduced`): the matrix is nearly singular along x.

A pair inside a group says nothing of f and s; it would only shift the objective by a multiple of s. Such
pairs take no part, and have dual 0.
"""
