"""Checks of rows and calibrations. Each file answers one question about them and returns diagnostics.

| question | before a calibration (nominal robot) | after it (linearised residuals) | rows under a model |
|---|---|---|---|
| Does a fault of setup or file explain all errors? | `setup_fault` | `setup_fault` | `setup_fault`, `other_sensors` |
| Was another robot measured? | `other_robot` | `other_robot` | `other_robot` |
| Did frame or tool move during the session? | `row_order.instrument_moved_error` | `row_order` | `mixed_rows` |
| Are rows of two setups mixed? | | `mixed_rows.check_two_populations` | `mixed_rows` |
| Are single rows wrong? | | robust loss of the calibration | `wrong_rows` |
| Were joint values logged too early, or rounded? | | `lag`, `rounding` | |
| Do gears have backlash that the rows do not state? | | `backlash` (before the calibration) | |
| Do measured torques have the sign of the drives? | | `torques` | `model.stated_conditions` |
| Are all lengths wrong by one factor? | `setup_fault.check_position_spread` | `scale` | `scale` |
| Do large errors remain that nothing explains? | | `unexplained` | `unexplained` |

What has moved since a calibration, and which rows are wrong under it, are questions about the posterior of a model:
`pisigma.lifetime.recalibration` and `pisigma.estimation.wrong_rows`. `pisigma.validation.gate` asks all questions for
every command.
"""
