//! Simulation: a scene, a trajectory and a rig in, images with known truth out.
