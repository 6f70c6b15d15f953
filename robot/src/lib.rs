//! The `robot` process as a library.
