# SPDX-License-Identifier: MIT
"""The tests that judge a port, one file a stage; `conformance.suite.run_suite` runs them."""
