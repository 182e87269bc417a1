"""The notes' system in forms to run: eliminated in O(bodies), and integrated by collocation in batches."""
