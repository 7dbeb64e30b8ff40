"""Controllers behind one interface: MPC, PI, and the MPC's linear equivalent."""
