{{/* Names and labels. One release of the chart is one service. */}}
{{- define "fathom.name" -}}
{{- if contains "fathom" .Release.Name }}{{ .Release.Name | trunc 40 | trimSuffix "-" }}{{ else }}{{ printf "%s-fathom" .Release.Name | trunc 40 | trimSuffix "-" }}{{ end }}
{{- end }}

{{- define "fathom.labels" -}}
helm.sh/chart: {{ .Chart.Name }}-{{ .Chart.Version }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
{{ include "fathom.selector" . }}
{{- end }}

{{- define "fathom.selector" -}}
app.kubernetes.io/name: fathom
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end }}

{{- define "fathom.tag" -}}
{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{- define "fathom.scheme" -}}
{{ if .Values.coordinator.tlsSecret }}https{{ else }}http{{ end }}
{{- end }}

{{/* What the settings of a service must not leave open. */}}
{{- define "fathom.check" -}}
{{- $c := .Values.coordinator }}
{{- if and (not $c.insecure) (or (not $c.tlsSecret) (not $c.tokens)) }}
{{- fail "anyone in the cluster could read and control everything: set coordinator.tlsSecret and coordinator.tokens, or coordinator.insecure" }}
{{- end }}
{{- if and .Values.keda.enabled (not $c.insecure) (or (not .Values.keda.clientSecret) (not .Values.keda.clientCaSecret)) }}
{{- fail "KEDA must show a certificate: set keda.clientSecret and keda.clientCaSecret, or coordinator.insecure" }}
{{- end }}
{{- if and .Values.keda.clientCaSecret (not $c.tlsSecret) }}
{{- fail "keda.clientCaSecret needs coordinator.tlsSecret: certificates are sent over TLS only" }}
{{- end }}
{{- if and (gt (int $c.replicas) 1) (or (not .Values.database.secret) (not .Values.objects.url)) }}
{{- fail "several coordinators share a database and a bucket: set database.secret and objects.url, or coordinator.replicas=1" }}
{{- end }}
{{- end }}

{{/* Containers run as the user of the image, with nothing that they do not need. */}}
{{- define "fathom.podSecurity" -}}
runAsNonRoot: true
runAsUser: 10001
runAsGroup: 10001
fsGroup: 10001
fsGroupChangePolicy: OnRootMismatch
seccompProfile: {type: RuntimeDefault}
{{- end }}

{{- define "fathom.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
{{- end }}

{{- define "fathom.pullSecrets" -}}
{{- with .Values.imagePullSecrets }}
imagePullSecrets:
  {{- range . }}
  - {name: {{ . }}}
  {{- end }}
{{- end }}
{{- end }}

{{/* The pod of a worker: (dict "root" $ "pool" POOL "once" true|false); with `once` it ends when idle. */}}
{{- define "fathom.worker" -}}
{{- $root := .root }}
{{- $w := $root.Values.workers }}
automountServiceAccountToken: false
securityContext: {{- include "fathom.podSecurity" $root | nindent 2 }}
terminationGracePeriodSeconds: {{ $w.terminationSeconds }}
restartPolicy: {{ ternary "Never" "Always" .once }}
{{- with $w.runtimeClassName }}
runtimeClassName: {{ . }}
{{- end }}
{{- include "fathom.pullSecrets" $root }}
containers:
  - name: worker
    image: {{ $root.Values.image.worker }}:{{ include "fathom.tag" $root }}
    imagePullPolicy: {{ $root.Values.image.pullPolicy }}
    securityContext: {{- include "fathom.containerSecurity" $root | nindent 6 }}
    ports: [{name: metrics, containerPort: 7422}]
    env:
      - {name: FATHOM_COORDINATOR, value: "{{ include "fathom.scheme" $root }}://{{ include "fathom.name" $root }}:7420"}
      - {name: FATHOM_GPU, value: all}
      - {name: FATHOM_WORKER_METRICS_LISTEN, value: "0.0.0.0:7422"}
      - name: FATHOM_WORKER_NAME
        valueFrom: {fieldRef: {fieldPath: metadata.name}}
      {{- if .once }}
      - {name: FATHOM_EXIT_WHEN_IDLE, value: "{{ $root.Values.keda.idleSeconds }}s"}
      {{- end }}
      {{- if $w.tokenSecret }}
      - {name: FATHOM_TOKEN_FILE, value: /etc/fathom/token/token}
      {{- end }}
      {{- if $root.Values.coordinator.tlsSecret }}
      - {name: FATHOM_TLS_CA, value: /etc/fathom/tls/ca.crt}
      {{- end }}
      {{- range $key, $value := $w.settings }}
      - {name: {{ $key }}, value: {{ $value | quote }}}
      {{- end }}
    livenessProbe: {httpGet: {path: /healthz, port: metrics}, periodSeconds: 30, timeoutSeconds: 5}
    readinessProbe: {httpGet: {path: /readyz, port: metrics}, periodSeconds: 10, timeoutSeconds: 5}
    {{- with .pool.resources }}
    resources: {{- toYaml . | nindent 6 }}
    {{- end }}
    volumeMounts:
      - {name: cache, mountPath: /var/cache/fathom}
      - {name: tmp, mountPath: /tmp}
      {{- if $w.tokenSecret }}
      - {name: token, mountPath: /etc/fathom/token, readOnly: true}
      {{- end }}
      {{- if $root.Values.coordinator.tlsSecret }}
      - {name: tls, mountPath: /etc/fathom/tls, readOnly: true}
      {{- end }}
volumes:
  - name: cache
    emptyDir: {sizeLimit: {{ $w.cacheSize }}}
  - name: tmp
    emptyDir: {}
  {{- with $w.tokenSecret }}
  - name: token
    secret: {secretName: {{ . }}, items: [{key: token, path: token}]}
  {{- end }}
  {{- with $root.Values.coordinator.tlsSecret }}
  - name: tls
    secret: {secretName: {{ . }}, items: [{key: ca.crt, path: ca.crt}]}
  {{- end }}
{{- with .pool.nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .pool.tolerations }}
tolerations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}
