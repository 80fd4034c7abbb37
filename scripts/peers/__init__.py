"""What we are compared with: other programs' solvers and mappers, called as their users would call them."""
