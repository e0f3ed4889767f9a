//! mot
