/* A wall clock of its own for the processes of a station: the host's, moved by an offset.

   CLOCK_REALTIME alone is moved. The offset [ns] is the first eight bytes of the file
   CHAOS_CLOCK, mapped, so that it changes for all processes at one moment and costs a read
   of memory. (libfaketime breaks clock_nanosleep on the monotonic clock, by which Python sleeps.)
   Times at which a wait on a clock of the day ends are moved back, as the kernel knows no offset. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const volatile int64_t *offset;
static int (*real_clock)(clockid_t, struct timespec *);
static int (*real_wait)(sem_t *, const struct timespec *);

__attribute__((constructor)) static void begin(void) {
  real_clock = dlsym(RTLD_NEXT, "clock_gettime");
  real_wait = dlsym(RTLD_NEXT, "sem_timedwait");
  const char *path = getenv("CHAOS_CLOCK");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *memory = mmap(NULL, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
  if (memory != MAP_FAILED) offset = memory;
  close(file);
}

static void move(struct timespec *t, int64_t ns) {
  int64_t all = t->tv_sec * 1000000000LL + t->tv_nsec + ns;
  t->tv_sec = all / 1000000000LL;
  t->tv_nsec = all % 1000000000LL;
}

int clock_gettime(clockid_t clock, struct timespec *t) {
  if (!real_clock) real_clock = dlsym(RTLD_NEXT, "clock_gettime");
  int status = real_clock(clock, t);
  if (status == 0 && offset && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE))
    move(t, *offset);
  return status;
}

int gettimeofday(struct timeval *restrict t, void *restrict zone) {
  struct timespec now;
  (void)zone;
  int status = clock_gettime(CLOCK_REALTIME, &now);
  t->tv_sec = now.tv_sec;
  t->tv_usec = now.tv_nsec / 1000;
  return status;
}

time_t time(time_t *t) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (t) *t = now.tv_sec;
  return now.tv_sec;
}

int sem_timedwait(sem_t *semaphore, const struct timespec *until) {
  struct timespec real = *until;
  if (offset) move(&real, -*offset);
  return real_wait(semaphore, &real);
}
