/* Read poses and print joint values, without Python:
 *
 *     gcc -I DIR library_example.c -L DIR -lpisigma_ik -lm -Wl,-rpath,DIR -o example && ./example DIR/model.psik < poses.txt
 *
 * A line contains the 16 numbers of a pose T_base_tool, row by row [m], and a joint value to stay close to for every joint
 * [rad or m], or nan for none. Printed are the status, the joint values, the two residuals, and the resulting pose.
 */
#include <math.h>
#include <stdio.h>

#include "pisigma_ik.h"

static int read_numbers(double *numbers, int count) {
    for (int i = 0; i < count; i++)
        if (scanf("%lf", &numbers[i]) != 1) return 0;
    return 1;
}

int main(int count, char **words) {
    char error[500] = "give a model file.";
    pisigma_model *model = count > 1 ? pisigma_load(words[1], error, sizeof error) : NULL;
    if (!model) {
        fprintf(stderr, "%s\n", error);
        return 2;
    }
    int joints = pisigma_joints(model);
    double pose[16], near_q[PISIGMA_MAX_JOINTS], reached[16];
    pisigma_solution solution;
    while (read_numbers(pose, 16) && read_numbers(near_q, joints)) {
        int status = pisigma_solve(model, pose, isnan(near_q[0]) ? NULL : near_q, NULL, PISIGMA_ANY_BRANCH, &solution);
        printf("%d", status);
        for (int j = 0; j < joints; j++) printf(" %.17g", solution.q[j]);
        printf(" %.17g %.17g", solution.position_residual, solution.rotation_residual);
        int moves = pisigma_forward(model, solution.q, NULL, reached) == 0;
        for (int i = 0; moves && i < 16; i++) printf(" %.17g", reached[i]);
        printf("\n");
    }
    pisigma_free(model);
    return 0;
}
