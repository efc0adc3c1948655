/* Interface between C programs and the kernels: reads a model file, checks arguments, stores results.
 *
 * PISIGMA_DESCRIPTION_SIZE, PISIGMA_MEMORY_SIZE and PISIGMA_LAYOUT are defined on the compiler's command line.
 */
#include "pisigma_ik.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SOLVE = 0, EVALUATE = 1 };

/* Entry point of the kernels, see pisigma/robot/kernels/kernels.py: description, memory, task, rows, T, near, near_rows, approach,
 * approach_rows, branch, mark, single, out, count. */
int32_t pisigma_run(int64_t *result, void **raised, const void *description, void *memory, int64_t task, int64_t rows,
                    double *T, const double *near_q, int64_t near_rows, const double *approach, int64_t approach_rows,
                    const double *axes, int64_t axes_rows, int64_t branch, int64_t mark, int64_t single, double *out,
                    int64_t count);

typedef struct {
    char magic[8];
    uint64_t layout, description_size, memory_size, joints, branches, segments, names_size;
    int64_t arm; /* arm to evaluate; -1 for none */
    double lowest[PISIGMA_MAX_JOINTS], highest[PISIGMA_MAX_JOINTS]; /* range of `near_q` */
    uint64_t axes_rows; /* 0 if all axes of the tool are constrained */
    double axes[8];     /* else the constrained axes, see pisigma/robot/kinematics/task_axes.py */
} file_head;

struct pisigma_model {
    file_head head;
    char *names; /* names of the branches, each terminated by a zero */
    unsigned char *description;
};

static uint32_t checksum(uint32_t sum, const void *data, size_t size) {
    const unsigned char *bytes = data;
    sum = ~sum;
    for (size_t i = 0; i < size; i++) {
        sum ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) sum = (sum >> 1) ^ (0xEDB88320u & (0u - (sum & 1u)));
    }
    return ~sum;
}

static int take(FILE *stream, void *target, size_t size, uint32_t *sum) {
    if (fread(target, 1, size, stream) != size) return 0;
    *sum = checksum(*sum, target, size);
    return 1;
}

static const char *fill(pisigma_model *model, FILE *stream) {
    static const char *const cut = "is truncated or was changed; export the model again";
    file_head *head = &model->head;
    uint32_t sum = 0, stated;
    if (!take(stream, head, sizeof *head, &sum) || memcmp(head->magic, "PSIGIK01", 8) != 0)
        return "is not a model file of this library";
    if (head->layout != PISIGMA_LAYOUT || head->description_size != PISIGMA_DESCRIPTION_SIZE ||
        head->memory_size != PISIGMA_MEMORY_SIZE)
        return "was exported by another version; use the library that was exported together with it";
    if (head->joints > PISIGMA_MAX_JOINTS || head->names_size > 4096) return cut;
    model->names = calloc(1, head->names_size + 1);
    model->description = calloc(1, PISIGMA_DESCRIPTION_SIZE);
    if (!model->names || !model->description) return "does not fit into memory";
    if (!take(stream, model->names, head->names_size, &sum)) return cut;
    for (uint64_t i = 0; i < head->segments; i++) {
        uint64_t at[2]; /* first byte and number of bytes */
        if (!take(stream, at, sizeof at, &sum)) return cut;
        if (at[0] > PISIGMA_DESCRIPTION_SIZE || at[1] > PISIGMA_DESCRIPTION_SIZE - at[0]) return cut;
        if (!take(stream, model->description + at[0], at[1], &sum)) return cut;
    }
    if (fread(&stated, sizeof stated, 1, stream) != 1 || stated != sum) return cut;
    return NULL;
}

pisigma_model *pisigma_load(const char *file, char *error, size_t room) {
    FILE *stream = fopen(file, "rb");
    pisigma_model *model = stream ? calloc(1, sizeof *model) : NULL;
    const char *wrong = !stream ? "cannot be opened" : model ? fill(model, stream) : "does not fit into memory";
    if (stream) fclose(stream);
    if (!wrong) return model;
    if (error) snprintf(error, room, "%s: %s.", file, wrong);
    pisigma_free(model);
    return NULL;
}

void pisigma_free(pisigma_model *model) {
    if (!model) return;
    free(model->names);
    free(model->description);
    free(model);
}

int pisigma_joints(const pisigma_model *model) { return (int)model->head.joints; }

int pisigma_branches(const pisigma_model *model) { return (int)model->head.branches; }

const char *pisigma_branch_name(const pisigma_model *model, int branch) {
    const char *name = model->names;
    if (branch < 0 || branch >= pisigma_branches(model)) return NULL;
    while (branch--) name += strlen(name) + 1;
    return name;
}

static int64_t run(const pisigma_model *model, int64_t task, double *pose, const double *near_q, const double *approach,
                   int64_t branch, double *out) {
    _Alignas(64) unsigned char memory[PISIGMA_MEMORY_SIZE];
    int64_t result[2] = {0, 0};
    memset(memory, 0, sizeof memory);
    pisigma_run(&result[0], (void **)&result[1], model->description, memory, task, 1, pose, near_q, near_q != NULL,
                approach, approach != NULL, model->head.axes, (int64_t)model->head.axes_rows, branch, 1, 0, out, 1);
    return result[0];
}

int pisigma_solve(const pisigma_model *model, const double pose[16], const double *near_q, const double *approach,
                  int branch, pisigma_solution *solution) {
    int dof = pisigma_joints(model);
    double T[16], near[PISIGMA_MAX_JOINTS], out[2 * PISIGMA_MAX_JOINTS + 5];
    memcpy(T, pose, sizeof T);
    for (int j = 0; near_q && j < dof; j++) {
        int possible = near_q[j] >= model->head.lowest[j] && near_q[j] <= model->head.highest[j];
        near[j] = possible ? near_q[j] : NAN; /* probably in degrees: INVALID_POSE */
    }
    for (int j = 0; approach && j < dof; j++)
        if (approach[j] != -1.0 && approach[j] != 0.0 && approach[j] != 1.0) T[0] = NAN;
    if (branch >= pisigma_branches(model) || branch < PISIGMA_ANY_BRANCH) T[0] = NAN, branch = PISIGMA_ANY_BRANCH;
    run(model, SOLVE, T, near_q ? near : NULL, approach, branch, out);
    for (int j = 0; j < PISIGMA_MAX_JOINTS; j++) {
        solution->q[j] = j < dof ? out[j] : NAN;
        solution->q_nominal[j] = j < dof ? out[dof + j] : NAN;
    }
    solution->position_residual = out[2 * dof];
    solution->rotation_residual = out[2 * dof + 1];
    solution->domain_measure = out[2 * dof + 2];
    solution->branch = (int)out[2 * dof + 4];
    return solution->status = (int)out[2 * dof + 3];
}

int pisigma_forward(const pisigma_model *model, const double *q, const double *approach, double pose[16]) {
    double out[7 * PISIGMA_MAX_JOINTS + 1];
    if (model->head.arm < 0) return -1;
    run(model, EVALUATE, pose, q, approach, model->head.arm, out);
    return 0;
}
