# Fits one model in R and appends its numbers to a table.
#   Rscript mixed_fixtures.R CASE KIND FORMULA DATA.csv OUTPUT.csv FITTERS
# lme4's own tolerance for the mode (tolPwrss = 1e-7) costs it up to 0.01 of log-likelihood and 1.5 %
# of standard errors; with 1e-10 it agrees with glmmTMB to four digits.
# KIND is logistic (FITTERS: lme4 and/or glmmTMB, by commas) or linear (lme4 with lmerTest).
suppressMessages({library(lme4); library(lmerTest); library(glmmTMB)})
arguments <- commandArgs(trailingOnly = TRUE)
case <- arguments[1]; kind <- arguments[2]; model <- as.formula(arguments[3])
data <- read.csv(arguments[4], stringsAsFactors = TRUE)
rows <- list()
keep <- function(fitter, quantity, term, value)
  rows[[length(rows) + 1]] <<- data.frame(case, fitter, quantity, term,
                                          value = sprintf("%.12g", as.numeric(value)))
keep_table <- function(fitter, estimates, columns)
  for (quantity in names(columns))
    keep(fitter, quantity, rownames(estimates), estimates[, columns[[quantity]]])

# Standard deviations and correlations of the random effects; an intercept has the name of its group.
# Uncorrelated effects of a group are named GROUP, GROUP.1 and so on in R.
keep_random <- function(fitter, spread) {
  group <- sub("[.][0-9]+$", "", spread$grp)
  slope <- !is.na(spread$var1) & spread$var1 != "(Intercept)"
  pair <- !is.na(spread$var2)
  term <- ifelse(slope, paste0(group, ": ", spread$var1), group)
  keep(fitter, "sd", term[!pair], spread$sdcor[!pair])
  if (any(pair)) keep(fitter, "r", paste0(group, ": ", spread$var2)[pair], spread$sdcor[pair])
}
as_rows <- function(covariances) do.call(rbind, lapply(names(covariances), function(group) {
  sd <- attr(covariances[[group]], "stddev"); r <- attr(covariances[[group]], "correlation")
  rows <- data.frame(grp = group, var1 = names(sd), var2 = NA, sdcor = sd)
  if (length(sd) == 2 && isTRUE(r[1, 2] != 0))
    rows <- rbind(rows, data.frame(grp = group, var1 = names(sd)[1], var2 = names(sd)[2],
                                   sdcor = r[1, 2]))
  rows
}))

if (kind == "logistic") {
  fitters <- strsplit(arguments[6], ",")[[1]]
  if ("lme4" %in% fitters) {
    seconds <- system.time(fit <- glmer(model, data, family = binomial, nAGQ = 1,
      control = glmerControl(optimizer = "bobyqa", tolPwrss = 1e-10,
                             optCtrl = list(maxfun = 1e5))))[["elapsed"]]
    keep_table("lme4", coef(summary(fit)), list(b = 1, se = 2, p = 4))
    keep_random("lme4", as.data.frame(VarCorr(fit)))
    keep("lme4", "loglik", "", logLik(fit)); keep("lme4", "seconds", "", seconds)
  }
  if ("glmmTMB" %in% fitters) {
    seconds <- system.time(fit <- glmmTMB(model, data, family = binomial))[["elapsed"]]
    keep_table("glmmTMB", coef(summary(fit))$cond, list(b = 1, se = 2, p = 4))
    keep_random("glmmTMB", as_rows(VarCorr(fit)$cond))
    keep("glmmTMB", "loglik", "", logLik(fit)); keep("glmmTMB", "seconds", "", seconds)
  }
} else {
  seconds <- system.time(fit <- lmerTest::lmer(model, data, REML = TRUE))[["elapsed"]]
  seconds <- seconds + system.time(estimates <- coef(summary(fit)))[["elapsed"]]
  keep_table("lme4", estimates, list(b = 1, se = 2, df = 3, statistic = 4, p = 5))
  keep_random("lme4", as.data.frame(VarCorr(fit)))
  keep("lme4", "loglik", "", logLik(fit))
  keep("lme4", "singular", "", isSingular(fit)); keep("lme4", "seconds", "", seconds)
  joint <- anova(fit)
  keep("lme4", "joint F", rownames(joint), joint[["F value"]])
  keep("lme4", "joint df1", rownames(joint), joint[["NumDF"]])
  keep("lme4", "joint df2", rownames(joint), joint[["DenDF"]])
  keep("lme4", "joint p", rownames(joint), joint[["Pr(>F)"]])
}
write.table(do.call(rbind, rows), arguments[5], sep = ",", row.names = FALSE,
            col.names = FALSE, append = TRUE, qmethod = "double")
versions <- sapply(c("lme4", "lmerTest", "glmmTMB"), function(p) as.character(packageVersion(p)))
cat(paste(names(versions), versions, collapse = " "), R.version.string, "\n")
