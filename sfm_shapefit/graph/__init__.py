"""The view graph: nodes, pairs with directions, groups that move together, and rigidity."""
