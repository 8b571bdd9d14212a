# SPDX-License-Identifier: MIT
"""``pytest conformance/suite --port package.module:factory``: the suite in pytest's own run. `run_suite` takes no notice of it."""

pytest_plugins = ("conformance.pytest_plugin",)
