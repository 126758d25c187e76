/* Two cars on the narrow road, driven by an exported controller in a periodic loop with absolute deadlines.

       loop [rate=500] [theta=1,1] [seed=0] [episodes=1] [start=px,py,psi,v,px,py,psi,v] [fifo=PRIORITY]
            [fast=1] [trace=FILE]

   At the beginning of every period the state is read and controls are computed, which the cars have until the end of it.
   Controls that are not there when the period ends have missed their deadline: the cars have driven on with the controls
   before. fast=1 does not wait and misses nothing, for tests; trace=FILE gets times, states and controls of the last
   episode. The exit code is 0, 1 if the controller or the system refuses, 2 for words that make no sense. Nothing is
   allocated in the loop. */
#define _POSIX_C_SOURCE 200809L
#include "hno_controller.h"

#include <errno.h>
#include <math.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>

#if HNO_PLAYERS != 2 || HNO_STATES != 4 || HNO_CONTROLS != 2
#error "This loop is for the narrow road: two players with four states and two controls each."
#endif

enum { JOINT = HNO_PLAYERS * HNO_STATES, INPUTS = HNO_PLAYERS * HNO_CONTROLS, SUBSTEPS = 4, MOST_RATE = 20000 };
enum { MOST_STEPS = ((int)HNO_HORIZON + 1) * MOST_RATE };

/* The game, as in hno/games/narrow_road.py with its defaults. */
static const char narrow_road[] = "8534716afe609a11";
static const double road_length = 70.0, least_radius = 1.25;
static const double start_low[HNO_STATES] = {15, 3.25, -0.0174533, 18}, start_high[HNO_STATES] = {20, 4.75, 0.0174533, 25};

typedef struct {
    double rate, theta[HNO_PLAYERS], start[JOINT];
    long episodes, seed, fifo, fast, placed; /* placed: whether there is a start */
    const char *trace;
} options;

typedef struct {
    long periods, missed, warned;
    double worst_wake, worst_compute, compute, closest; /* s, s, s in all, m */
} outcome;

typedef struct {
    double x[JOINT];
    float u[INPUTS], held[INPUTS]; /* new ones, and those that the cars have */
    long k, steps;
    double period;
} loop;

static struct { double x[JOINT]; float u[INPUTS]; } path[MOST_STEPS];

static void rate_of(const double *x, const float *u, double *out)
{
    for (int i = 0; i < HNO_PLAYERS; i++, x += HNO_STATES, u += HNO_CONTROLS, out += HNO_STATES) {
        out[0] = x[3] * cos(x[2]);
        out[1] = x[3] * sin(x[2]);
        out[2] = (double)u[0];
        out[3] = (double)u[1];
    }
}

static void runge_kutta(double *x, const float *u, double dt)
{
    static const double at[4] = {0, 0.5, 0.5, 1}, weight[4] = {1, 2, 2, 1};
    double slope[JOINT] = {0}, sum[JOINT] = {0}, inner[JOINT];
    for (int stage = 0; stage < 4; stage++) {
        for (int k = 0; k < JOINT; k++) inner[k] = x[k] + at[stage] * dt * slope[k];
        rate_of(inner, u, slope);
        for (int k = 0; k < JOINT; k++) sum[k] += weight[stage] * slope[k];
    }
    for (int k = 0; k < JOINT; k++) x[k] += dt / 6 * sum[k];
}

static double distance(const double *x)
{
    return hypot(x[0] - (road_length - x[HNO_STATES]), x[1] - x[HNO_STATES + 1]);
}

static double radius(const double *theta)
{
    return 0.1 * (theta[0] + theta[1]) + 0.05 * fmin(theta[0], theta[1]) + least_radius;
}

/* The cars drive for one period with the controls that they have. */
static void move(loop *now, outcome *found)
{
    memcpy(path[now->k].x, now->x, sizeof now->x);
    memcpy(path[now->k].u, now->held, sizeof now->held);
    for (int k = 0; k < SUBSTEPS; k++) {
        runge_kutta(now->x, now->held, now->period / SUBSTEPS);
        found->closest = fmin(found->closest, distance(now->x));
    }
    now->k++;
    found->periods++;
}

/* Whole periods that have passed meanwhile: their controls have missed their deadlines. */
static void catch_up(loop *now, double t, outcome *found)
{
    while (now->k < now->steps && t >= (double)(now->k + 1) * now->period) {
        move(now, found);
        found->missed++;
    }
}

static double since(const struct timespec *begin)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)(now.tv_sec - begin->tv_sec) + 1e-9 * (double)(now.tv_nsec - begin->tv_nsec);
}

static void wait_until(const struct timespec *begin, double t)
{
    const long long nanoseconds = begin->tv_nsec + llround(1e9 * t);
    struct timespec at = {.tv_sec = begin->tv_sec + nanoseconds / 1000000000, .tv_nsec = nanoseconds % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL) == EINTR) continue;
}

/* The controller at the state that the cars are in; its return code. */
static int ask(const hno_prepared *prepared, loop *now)
{
    float x[JOINT];
    for (int k = 0; k < JOINT; k++) x[k] = (float)now->x[k];
    return hno_control(prepared, (float)((double)HNO_HORIZON - (double)now->k * now->period), x, now->u);
}

/* One episode; the return code is the controller's. */
static int play(const options *given, const hno_prepared *prepared, const double *start, outcome *found)
{
    loop now = {.period = 1 / given->rate, .steps = lround((double)HNO_HORIZON * given->rate)};
    struct timespec begin;

    memcpy(now.x, start, sizeof now.x);
    found->closest = fmin(found->closest, distance(start));
    clock_gettime(CLOCK_MONOTONIC, &begin);
    while (now.k < now.steps) {
        const double due = (double)now.k * now.period;
        if (!given->fast) wait_until(&begin, due);
        const double woke = since(&begin);
        if (!given->fast) catch_up(&now, woke, found);
        if (now.k == now.steps) break;
        const int code = ask(prepared, &now);
        const double ready = since(&begin);
        if (code < 0) return code;
        found->warned += code > 0;
        found->worst_wake = fmax(found->worst_wake, woke - due);
        found->worst_compute = fmax(found->worst_compute, ready - woke);
        found->compute += ready - woke;
        if (!given->fast) catch_up(&now, ready, found);
        memcpy(now.held, now.u, sizeof now.held);
        if (now.k < now.steps) move(&now, found);
    }
    return HNO_OK;
}

/* Uniform in the start box (xorshift64*). */
static void random_start(long seed, double *x)
{
    unsigned long long bits = 0x9E3779B97F4A7C15ull * (unsigned long long)(seed + 1);
    for (int k = 0; k < JOINT; k++) {
        bits ^= bits >> 12, bits ^= bits << 25, bits ^= bits >> 27;
        const double share = (double)((bits * 0x2545F4914F6CDD1Dull) >> 11) / 9007199254740992.0;
        x[k] = start_low[k % HNO_STATES] + share * (start_high[k % HNO_STATES] - start_low[k % HNO_STATES]);
    }
}

static int numbers(const char *text, int count, double *out)
{
    for (int k = 0; k < count; k++) {
        char *end;
        out[k] = strtod(text, &end);
        if (end == text || !isfinite(out[k]) || *end != (k + 1 < count ? ',' : 0)) return 0;
        text = end + 1;
    }
    return 1;
}

static int whole(const char *text, long least, long most, long *out)
{
    double found;
    if (!numbers(text, 1, &found) || found < (double)least || found > (double)most || found != floor(found)) return 0;
    *out = (long)found;
    return 1;
}

static int understood(const char *word, options *given)
{
    const char *value = strchr(word, '=');
    const size_t length = value == NULL ? 0 : (size_t)(value++ - word);
#define IS(name) (length == sizeof(name) - 1 && strncmp(word, name, length) == 0)
    long rate;
    if (IS("rate")) return whole(value, 1, MOST_RATE, &rate) ? given->rate = (double)rate, 1 : 0;
    if (IS("theta")) return numbers(value, HNO_PLAYERS, given->theta);
    if (IS("start")) return given->placed = numbers(value, JOINT, given->start), given->placed != 0;
    if (IS("episodes")) return whole(value, 1, 1000000, &given->episodes);
    if (IS("seed")) return whole(value, 0, 1000000000, &given->seed);
    if (IS("fifo")) return whole(value, 1, 99, &given->fifo);
    if (IS("fast")) return whole(value, 0, 1, &given->fast);
    if (IS("trace")) return given->trace = value, *value != 0;
    return 0;
}

/* What a system may refuse: it is said, and the loop runs without. */
static void prepare_system(const options *given)
{
    if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) printf("memory is not locked: %s\n", strerror(errno));
    if (given->fifo == 0) return;
    const struct sched_param wanted = {.sched_priority = (int)given->fifo};
    if (sched_setscheduler(0, SCHED_FIFO, &wanted) != 0) printf("no SCHED_FIFO here: %s\n", strerror(errno));
    else printf("SCHED_FIFO, priority %ld\n", given->fifo);
}

static int write_path(const options *given)
{
    FILE *file = fopen(given->trace, "w");
    if (file == NULL) return 0;
    for (long k = 0; k < lround((double)HNO_HORIZON * given->rate); k++) {
        fprintf(file, "%.9g", (double)k / given->rate);
        for (int entry = 0; entry < JOINT; entry++) fprintf(file, " %.9g", path[k].x[entry]);
        for (int entry = 0; entry < INPUTS; entry++) fprintf(file, " %.9g", (double)path[k].u[entry]);
        fprintf(file, "\n");
    }
    return fclose(file) == 0;
}

static void report(const options *given, const outcome *found, long collided)
{
    const double answered = (double)(found->periods - found->missed);
    printf("%g Hz, %ld episodes of %g s, %ld periods\n", given->rate, given->episodes, (double)HNO_HORIZON, found->periods);
    if (given->fast) printf("not timed: fast=1\n");
    else printf("missed deadlines: %ld (%.3g %%)\n", found->missed, 100 * (double)found->missed / (double)found->periods);
    if (!given->fast) printf("worst wake-up: %.1f us late\n", 1e6 * found->worst_wake);
    printf("controls computed in: %.1f us on average, %.1f us at worst\n", 1e6 * found->compute / answered,
           1e6 * found->worst_compute);
    printf("closest distance: %.3f m, collision below %.3f m: %ld of %ld episodes collided\n", found->closest,
           radius(given->theta), collided, given->episodes);
    if (found->warned > 0) printf("%ld controls were computed outside the PDE box or the type box\n", found->warned);
}

int main(int count, char **words)
{
    options given = {.rate = 500, .theta = {1, 1}, .episodes = 1};
    outcome found = {.closest = HUGE_VAL};
    hno_prepared prepared;
    double closest = HUGE_VAL;
    long collided = 0;

    for (int k = 1; k < count; k++) {
        if (understood(words[k], &given)) continue;
        fprintf(stderr, "What is %s? See the head of loop.c; rate is a whole number up to %d.\n", words[k], MOST_RATE);
        return 2;
    }
    if (strcmp(HNO_FINGERPRINT, narrow_road) != 0) {
        fprintf(stderr, "The controller is of another game, or of a narrow road with other constants.\n");
        return 1;
    }
    if (!given.fast) prepare_system(&given);
    const float theta[HNO_PLAYERS] = {(float)given.theta[0], (float)given.theta[1]};
    int code = hno_prepare(theta, &prepared);
    for (long episode = 0; code >= 0 && episode < given.episodes; episode++) {
        if (!given.placed) random_start(given.seed + episode, given.start);
        found.closest = HUGE_VAL;
        code = play(&given, &prepared, given.start, &found);
        collided += found.closest <= radius(given.theta);
        closest = fmin(closest, found.closest);
    }
    if (code < 0) {
        fprintf(stderr, "The controller refused with code %d after %ld periods; see hno_controller.h.\n", code, found.periods);
        return 1;
    }
    found.closest = closest;
    report(&given, &found, collided);
    if (given.trace == NULL || write_path(&given)) return 0;
    fprintf(stderr, "%s cannot be written: %s\n", given.trace, strerror(errno));
    return 1;
}
