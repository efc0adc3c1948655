/* Corrected inverse kinematics of a calibrated robot, from C.
 *
 * Lengths in metres, angles in radians. Poses are homogeneous transforms T_base_tool, 16 numbers row by row.
 * Solving allocates nothing, takes about 50 kB of the stack, and may be done by several threads with one model.
 */
#ifndef PISIGMA_IK_H
#define PISIGMA_IK_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { PISIGMA_MOST_JOINTS = 8 };

enum pisigma_status {
    PISIGMA_REACHED = 0,
    PISIGMA_SINGULAR = 1,
    PISIGMA_OUTSIDE_JOINT_LIMITS = 2,
    PISIGMA_OUTSIDE_DOMAIN = 3,
    PISIGMA_UNREACHABLE = 4, /* no joint values: they are NaN */
    PISIGMA_INVALID_POSE = 6 /* the same */
};

enum { PISIGMA_ANY_BRANCH = -1 };

typedef struct pisigma_model pisigma_model;

typedef struct {
    int status;                            /* enum pisigma_status */
    int branch;                            /* index */
    double q[PISIGMA_MOST_JOINTS];         /* joint values to command [rad or m]; NaN behind the last joint */
    double q_nominal[PISIGMA_MOST_JOINTS]; /* those of the robot as drawn */
    double position_residual;              /* [m] */
    double rotation_residual;              /* [rad] */
    double domain_measure;                 /* above 1 the correction is extrapolated */
} pisigma_solution;

/* Load a model file. NULL where it cannot be used; then `error` (`room` bytes, may be NULL) says why. */
pisigma_model *pisigma_load(const char *file, char *error, size_t room);
void pisigma_free(pisigma_model *model);

int pisigma_joints(const pisigma_model *model);
int pisigma_branches(const pisigma_model *model);
/* Name of a branch; NULL where there is none. */
const char *pisigma_branch_name(const pisigma_model *model, int branch);

/* Solve one pose; gives the status, which stands in the solution too.
 *
 * near_q: joint values to be near to, such as the present ones, or NULL.
 * approach: for every joint +1, -1 or 0, the side from which it will come, or NULL.
 * branch: index of the branch to take, or PISIGMA_ANY_BRANCH.
 */
int pisigma_solve(const pisigma_model *model, const double pose[16], const double *near_q, const double *approach,
                  int branch, pisigma_solution *solution);

/* The pose that the calibrated arm takes at commanded joint values. 0, or -1 where the model has a network that corrects
 * nominal joint values, which says nothing about it. */
int pisigma_forward(const pisigma_model *model, const double *q, const double *approach, double pose[16]);

#ifdef __cplusplus
}
#endif

#endif
