//! The `operator` process as a library.
