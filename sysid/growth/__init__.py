"""Terms added to and pruned from a network, judged on held-out logs."""
