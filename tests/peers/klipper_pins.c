/* Hardware for Klipper's own micro-controller program, built for Linux: loaded before it.

   That program asks the kernel for GPIO lines and for analog inputs. Here they are a cartesian
   printer with a nozzle and a bed that heat, wired as `live_klipper.CONFIG` says:

   line 4k+1 steps axis k, 4k+2 is its direction, 4k+3 its end stop, at its lowest end;
   line 13 is a probe: it triggers FELT_STEPS (of the environment) above Z's end stop and below;
   line 21 steps the extruder;
   line 23 heats the nozzle (analog 0), line 24 the bed (analog 1).

   A heater is a first-order system; an analog value is linear, 0 to 400 degrees.

   A board's own clock drives its steps; this one's is the machine's, which gives it a turn when it
   likes: 1 ms late in the midst of a move, and the program shuts down (Stepper too far in past).
   So while it steps, its clock waits for it: it goes on no further than LATE_S past what was due,
   or since it was last asked. What it so loses to the machine's clock, milliseconds in a minute,
   klippy takes for a slow quartz.

       cc -shared -fPIC -O2 -o pins.so klipper_pins.c -ldl */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <linux/gpio.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

enum { FDS = 1024, LINES = 64, AXES = 3, PROBE = 13, PUSHES = 21, NOZZLE = 23, BED = 24 };
static const char GPIO[] = "/dev/gpiochip0";
static const char ANALOG[] = "/sys/bus/iio/devices/iio:device0/in_voltage";
static const double LATE_S = 2e-4, STEPS_S = 0.05;
static const double ROOM_C = 22.0, HIGHEST_C = 400.0, HIGHEST_VALUE = 4095.0;

static struct { int is_line, line, is_input, input; } opened[FDS];
static unsigned char level[LINES];
static long steps[AXES] = {60, 60, 60};  /* above its end stop, at first */

static struct heater { int line; double gain_c_s, fade_s, at_c, since_s; } heaters[] = {
    {NOZZLE, 15.0, 60.0, 22.0, 0.0},
    {BED, 5.0, 120.0, 22.0, 0.0},
};

enum { SECOND_NS = 1000000000 };
static long long lost_ns, due_ns, told_ns, stepped_ns;  /* the last three by its own clock */

static long long ns_of(struct timespec t)
{
    return t.tv_sec * (long long)SECOND_NS + t.tv_nsec;
}

static struct timespec from_ns(long long ns)
{
    return (struct timespec){ns / SECOND_NS, ns % SECOND_NS};
}

int clock_gettime(clockid_t clock, struct timespec *into)
{
    static int (*real)(clockid_t, struct timespec *);
    if (!real)
        real = dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(clock, into);
    if (failed || clock != CLOCK_MONOTONIC)
        return failed;
    long long now_ns = ns_of(*into) - lost_ns;
    long long most_ns = (due_ns > told_ns ? due_ns : told_ns) + (long long)(LATE_S * SECOND_NS);
    int steps_now = stepped_ns && told_ns - stepped_ns < (long long)(STEPS_S * SECOND_NS);
    if (steps_now && now_ns > most_ns) {
        lost_ns += now_ns - most_ns;
        now_ns = most_ns;
    }
    told_ns = now_ns;
    *into = from_ns(now_ns);
    return 0;
}

int timer_settime(timer_t timer, int flags, const struct itimerspec *when, struct itimerspec *was)
{
    static int (*real)(timer_t, int, const struct itimerspec *, struct itimerspec *);
    if (!real)
        real = dlsym(RTLD_NEXT, "timer_settime");
    due_ns = ns_of(when->it_value);
    struct itimerspec then = {when->it_interval, from_ns(due_ns + lost_ns)};
    return real(timer, flags, &then, was);
}

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return ns_of(t) * 1e-9;
}

static void warm(struct heater *h)
{
    double now = now_s(), took = h->since_s ? now - h->since_s : 0.0;
    double end_c = ROOM_C + (level[h->line] ? h->gain_c_s * h->fade_s : 0.0);
    h->at_c = end_c + (h->at_c - end_c) * exp(-took / h->fade_s);
    h->since_s = now;
}

static void write_line(int line, int value)
{
    int axis = (line - 1) / 4;
    for (int k = 0; k < 2; k++)
        if (heaters[k].line == line)
            warm(&heaters[k]);
    if (axis < AXES && line % 4 == 1 && value && !level[line])
        steps[axis] += level[line + 1] ? 1 : -1;
    if ((axis < AXES || line == PUSHES) && line % 4 == 1)
        stepped_ns = told_ns;
    level[line] = value;
}

static int read_line(int line)
{
    int axis = (line - 1) / 4;
    if (line == PROBE)
        return getenv("FELT_STEPS") && steps[2] <= atol(getenv("FELT_STEPS"));
    return axis < AXES && line % 4 == 3 && steps[axis] <= 0;
}

static int new_fd(int (*real)(const char *, int, ...))
{
    int fd = real("/dev/null", O_RDWR | O_CLOEXEC);
    if (fd >= 0 && fd < FDS)
        memset(&opened[fd], 0, sizeof opened[fd]);
    return fd;
}

int open(const char *path, int flags, ...)
{
    int (*real)(const char *, int, ...) = dlsym(RTLD_NEXT, "open");
    if (!strcmp(path, GPIO))
        return new_fd(real);
    if (!strncmp(path, ANALOG, sizeof ANALOG - 1)) {
        int fd = new_fd(real);
        opened[fd].is_input = 1;
        opened[fd].input = path[sizeof ANALOG - 1] - '0';
        return fd;
    }
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    return real(path, flags, mode);
}

int access(const char *path, int how)
{
    int (*real)(const char *, int) = dlsym(RTLD_NEXT, "access");
    return strcmp(path, GPIO) ? real(path, how) : 0;
}

int ioctl(int fd, unsigned long request, ...)
{
    static int (*real)(int, unsigned long, ...);
    if (!real)
        real = dlsym(RTLD_NEXT, "ioctl");
    va_list rest;
    va_start(rest, request);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    if (request == GPIO_GET_LINEHANDLE_IOCTL) {
        struct gpiohandle_request *wanted = argument;
        wanted->fd = new_fd(dlsym(RTLD_NEXT, "open"));
        opened[wanted->fd].is_line = 1;
        opened[wanted->fd].line = wanted->lineoffsets[0] % LINES;
        if (wanted->flags & GPIOHANDLE_REQUEST_OUTPUT)
            write_line(opened[wanted->fd].line, wanted->default_values[0]);
        return 0;
    }
    if (fd >= 0 && fd < FDS && opened[fd].is_line) {
        struct gpiohandle_data *data = argument;
        if (request == GPIOHANDLE_SET_LINE_VALUES_IOCTL)
            write_line(opened[fd].line, data->values[0]);
        else
            data->values[0] = read_line(opened[fd].line);
        return 0;
    }
    return real(fd, request, argument);
}

ssize_t pread(int fd, void *into, size_t most, off_t from)
{
    ssize_t (*real)(int, void *, size_t, off_t) = dlsym(RTLD_NEXT, "pread");
    if (fd < 0 || fd >= FDS || !opened[fd].is_input)
        return real(fd, into, most, from);
    struct heater *h = &heaters[opened[fd].input % 2];
    warm(h);
    return snprintf(into, most, "%d", (int)lround(h->at_c / HIGHEST_C * HIGHEST_VALUE));
}
