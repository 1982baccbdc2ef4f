//! driml-tests
