/* Corrected inverse kinematics of a calibrated robot, from C.
 *
 * Lengths are in metres, angles in radians. Poses are homogeneous transforms T_base_tool, 16 numbers row by row.
 * Solving does not allocate memory, needs about 50 kB of stack, and may run in several threads with one model.
 */
#ifndef PISIGMA_IK_H
#define PISIGMA_IK_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { PISIGMA_MAX_JOINTS = 8 };

enum pisigma_status {
    PISIGMA_REACHED = 0,
    PISIGMA_SINGULAR = 1,
    PISIGMA_OUTSIDE_JOINT_LIMITS = 2,
    PISIGMA_OUTSIDE_DOMAIN = 3,
    PISIGMA_UNREACHABLE = 4, /* joint values are NaN */
    PISIGMA_INVALID_POSE = 6 /* joint values are NaN */
};

enum { PISIGMA_ANY_BRANCH = -1 };

typedef struct pisigma_model pisigma_model;

typedef struct {
    int status;                            /* enum pisigma_status */
    int branch;                            /* index */
    double q[PISIGMA_MAX_JOINTS];          /* joint values to command [rad or m]; NaN after the last joint */
    double q_nominal[PISIGMA_MAX_JOINTS];  /* joint values of the nominal robot */
    double position_residual;              /* [m] */
    double rotation_residual;              /* [rad] */
    double domain_measure;                 /* above 1 the correction is extrapolated */
} pisigma_solution;

/* Load a model file. Returns NULL and a message in `error` (`room` bytes, may be NULL) if the file cannot be used. */
pisigma_model *pisigma_load(const char *file, char *error, size_t room);
void pisigma_free(pisigma_model *model);

int pisigma_joints(const pisigma_model *model);
int pisigma_branches(const pisigma_model *model);
/* Name of a branch; NULL if there is no such branch. */
const char *pisigma_branch_name(const pisigma_model *model, int branch);

/* Solve one pose; returns the status, which is also in the solution.
 *
 * near_q: joint values that the solution should be close to, such as the present ones, or NULL.
 * approach: direction in which every joint moves to the pose, +1, -1 or 0 if not known, or NULL.
 * branch: index of the branch to use, or PISIGMA_ANY_BRANCH.
 */
int pisigma_solve(const pisigma_model *model, const double pose[16], const double *near_q, const double *approach,
                  int branch, pisigma_solution *solution);

/* Compute the pose of the calibrated arm at commanded joint values. Returns 0, or -1 for a model with a network on nominal
 * joint values, which does not predict it. */
int pisigma_forward(const pisigma_model *model, const double *q, const double *approach, double pose[16]);

#ifdef __cplusplus
}
#endif

#endif
