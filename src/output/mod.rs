//! Output: odometry in, shared memory, files and reports out.
