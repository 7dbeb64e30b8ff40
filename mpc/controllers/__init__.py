"""Controllers behind one interface: MPC, PI, LQR, and the MPC's linear equivalent."""
