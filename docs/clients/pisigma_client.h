/* A client of `pisigma serve` for C on systems with POSIX sockets: binary frames, in this one header.
 *
 * Lengths in metres, angles in radians. It needs a little-endian processor with IEEE 754 doubles.
 *
 *     int server = pisigma_connect("127.0.0.1", 5006);
 *     int status = pisigma_ask(server, 0, pose, q_now, 6, q);
 */
#ifndef PISIGMA_CLIENT_H
#define PISIGMA_CLIENT_H

#include <math.h>
#include <netdb.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/types.h>
#include <unistd.h>

enum { PISIGMA_JOINTS = 8, PISIGMA_NOT_SERVED = -1, PISIGMA_OTHER_ANSWER = -2 };

typedef struct {
    char magic[4];
    uint32_t length;
    uint64_t id;
    uint32_t model, flags;
    double pose[16], near_q[PISIGMA_JOINTS];
} pisigma_request;

typedef struct {
    char magic[4];
    uint32_t length;
    uint64_t id;
    uint32_t status, joints;
    double q[PISIGMA_JOINTS], position_residual, rotation_residual;
    uint8_t model[8]; /* first bytes of the SHA-256 of the model that answered */
} pisigma_answer;

_Static_assert(sizeof(pisigma_request) == 216 && sizeof(pisigma_answer) == 112, "frames have no gaps");

/* Connect; a file descriptor, or -1 with errno. */
static inline int pisigma_connect(const char *host, int port) {
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *list = NULL;
    char service[8];
    int server = -1, yes = 1;
    snprintf(service, sizeof service, "%d", port);
    if (getaddrinfo(host, service, &hints, &list) != 0) return -1;
    for (struct addrinfo *one = list; one && server < 0; one = one->ai_next) {
        server = socket(one->ai_family, one->ai_socktype, one->ai_protocol);
        if (server >= 0 && connect(server, one->ai_addr, one->ai_addrlen) != 0) {
            close(server);
            server = -1;
        }
    }
    freeaddrinfo(list);
    if (server >= 0) setsockopt(server, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    return server;
}

static inline int pisigma_transfer(int server, void *data, size_t size, int sending) {
    for (char *at = data; size > 0;) {
        ssize_t moved = sending ? send(server, at, size, MSG_NOSIGNAL) : recv(server, at, size, 0);
        if (moved <= 0) return 0;
        at += moved;
        size -= (size_t)moved;
    }
    return 1;
}

/* Send the token; 0 if it is the right one. */
static inline int pisigma_admit(int server, const char *token) {
    struct { char magic[4]; uint32_t length; uint64_t id; uint32_t model, flags; } head = {{'P', 'S', 'I', '1'}, 0, 0, 0, 1};
    pisigma_answer answer;
    head.length = (uint32_t)(sizeof head + strlen(token));
    if (!pisigma_transfer(server, &head, sizeof head, 1) || !pisigma_transfer(server, (char *)token, strlen(token), 1) ||
        !pisigma_transfer(server, &answer, sizeof answer, 0))
        return PISIGMA_NOT_SERVED;
    return (int)answer.status;
}

/* Ask for the joint values of one pose (16 numbers, row by row); gives the status, of which 0 is "reached".
 *
 * near_q: joint values to be near to, or NULL. q gets as many joint values as there are; NaN where there are none.
 * Below 0 the connection is of no use any more.
 */
static inline int pisigma_ask(int server, uint32_t model, const double pose[16], const double *near_q, int joints,
                              double *q) {
    static uint64_t last = 0;
    pisigma_request request = {{'P', 'S', 'I', '1'}, sizeof request, ++last, model, 0, {0}, {0}};
    pisigma_answer answer;
    memcpy(request.pose, pose, sizeof request.pose);
    for (int j = 0; j < PISIGMA_JOINTS; j++) request.near_q[j] = near_q && j < joints ? near_q[j] : NAN;
    if (!pisigma_transfer(server, &request, sizeof request, 1) || !pisigma_transfer(server, &answer, sizeof answer, 0))
        return PISIGMA_NOT_SERVED;
    if (memcmp(answer.magic, "PSI1", 4) != 0 || answer.length != sizeof answer || answer.id != request.id)
        return PISIGMA_OTHER_ANSWER;
    for (int j = 0; j < joints && j < PISIGMA_JOINTS; j++) q[j] = answer.q[j];
    return (int)answer.status;
}

#endif
